"""What is a group of knobs? Frozen, strict, every knob documented."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

PositiveInt = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0.0, lt=1.0)]
OFF = BeforeValidator(lambda value: "off" if value is False else value)  # YAML takes off for a truth value


class Section(BaseModel):
    """A group of knobs: frozen, and unknown keys are errors."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )
