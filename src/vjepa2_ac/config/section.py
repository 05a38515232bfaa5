"""Base class of config sections: frozen, strict, every knob documented."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from vjepa2_ac import places

PositiveInt = Annotated[int, Field(ge=1, le=1_000_000_000)]  # no machine has memory for more of anything
Count = Annotated[int, Field(ge=0)]
Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
ZeroToOne = Annotated[float, Field(ge=0.0, le=1.0)]
Share = Annotated[float, Field(ge=0.0, lt=1.0)]
OFF = BeforeValidator(lambda value: "off" if value is False else value)  # YAML reads off as a boolean
Place = Annotated[str, AfterValidator(places.anywhere)]  # on this machine, where ~ is the user's home, or a URL
Local = Annotated[str, AfterValidator(places.on_this_machine)]  # likewise, but no URL
LocalOrBuiltin = Annotated[str, AfterValidator(places.of_a_model)]  # likewise, or a part of the package


class Section(BaseModel):
    """A group of knobs: frozen, and unknown keys are errors."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )
