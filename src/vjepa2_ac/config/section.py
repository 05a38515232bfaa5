"""Base class of config sections: frozen, strict, every knob documented; and what each knob affects.

That is said at the knob, as `Annotated[…, Affects.RUN]`, and asked for wherever two things compare. A mark of a section
holds for the knobs in it that have none of their own. `AtMost` limits those that have.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Flag, auto
from functools import cache, reduce
from operator import or_
from typing import Annotated, Any, Self, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic.fields import FieldInfo

from vjepa2_ac.storage import places

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

    def refused(self, *rules: tuple[object, str]) -> Self:
        """Return the section, for a validator; each rule says when it is broken, and what is wrong then.

        Raises:
            ValueError: With what is wrong by the first rule that is broken.
        """
        for is_broken, why in rules:
            if is_broken:
                raise ValueError(why)
        return self


class Affects(Flag):
    """What is no longer the same when a knob has another value. What depends on the index changes with it."""

    NOTHING = 0  # how fast, where, what is written
    INDEX = auto()  # what is known of the episodes of a data set
    IDLE = auto()  # the steps in which the robot moves
    LATENTS = auto()  # a latent cache
    MEASURED = auto()  # what a validation measures, besides its clips, which are compared themselves
    RUN = auto()  # what a run computes: it does not go on with another value
    PLAN = auto()  # a decision: planning has no use for the others
    CLIPS = LATENTS | MEASURED | RUN
    FORM = INDEX | IDLE | LATENTS | RUN
    EPISODES = FORM | CLIPS


@dataclass(frozen=True)
class AtMost:
    """What the knobs of a section affect at most where it stands, whatever their own marks are."""

    mark: Affects


_ALL = AtMost(~Affects.NOTHING)


@cache
def marks_of(knobs: type[BaseModel]) -> Mapping[str, Affects]:
    """Return the mark of each knob of a section and of those in it, by its dotted key.

    Raises:
        TypeError: A knob has none: nobody could say what depends on it.
    """
    return dict(_marks(knobs, None, "", ~Affects.NOTHING))


@cache
def mark_of(key: str, knobs: type[BaseModel]) -> Affects:
    """Return the mark of a knob, or of that which holds a value, such as data.fields.cameras.left.

    That of a section is all that its knobs affect.

    Raises:
        KeyError: There is no such knob.
    """
    wanted = f"{key}."
    known = ((f"{name}.", mark) for name, mark in marks_of(knobs).items())
    found = [mark for name, mark in known if name.startswith(wanted) or wanted.startswith(name)]
    if not found:
        raise KeyError(key)
    return reduce(or_, found)


def knobs_that_affect(what: Affects, section: BaseModel) -> dict[str, Any]:
    """Return the knobs of a section, and of those in it, that affect any of these, as plain values.

    Raises:
        TypeError: As `marks_of`.
    """
    return _that_affect(what, section, type(section), "")


def _that_affect(what: Affects, section: BaseModel, knobs: type[BaseModel], prefix: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in type(section).model_fields:
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            if inner := _that_affect(what, value, knobs, f"{prefix}{name}."):
                found[name] = inner
        elif what & mark_of(prefix + name, knobs):
            found[name] = section.model_dump(mode="json", include={name})[name]
    return found


def _marks(
    section: type[BaseModel], outer: Affects | None, prefix: str, most: Affects
) -> Iterator[tuple[str, Affects]]:
    for name, field in section.model_fields.items():
        mark = _noted(field, Affects, outer)
        inner = sections_in(field.annotation)
        inner = [kind for one in inner for kind in [*getattr(one, "kinds", {}).values()] or [one]]
        for one in inner:
            yield from _marks(one, mark, f"{prefix}{name}.", most & _noted(field, AtMost, _ALL).mark)
        if not inner and mark is None:
            raise TypeError(f"{prefix}{name}: say what it affects, as in Annotated[int, Affects.RUN]")
        if not inner and mark is not None:
            yield prefix + name, mark & most


def _noted(field: FieldInfo, kind: type[Any], otherwise: Any) -> Any:
    """Return the note of a kind at a knob."""
    return next((one for one in field.metadata if isinstance(one, kind)), otherwise)


def sections_in(annotation: Any) -> list[type[BaseModel]]:
    """Return the sections that a knob of this type may hold."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [section for one in get_args(annotation) for section in sections_in(one)]
