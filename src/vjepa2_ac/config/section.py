"""Base class of config sections, annotations of what each config key affects, and components with options.

A section is annotated as a whole: with `Section.affects`, or with `Annotated[…, Affects.RUN]` where it is used as a
key. A key that affects something else than its section has its own annotation.

A component is configured by its name and, if needed, its options: `planner: icem`, or
`planner: {name: icem, options: {elites: 20}}`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Flag, auto
from functools import cache, reduce
from operator import or_
from typing import Annotated, Any, ClassVar, Self, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import core_schema

from vjepa2_ac.registry import Registry
from vjepa2_ac.storage import paths

PositiveInt = Annotated[int, Field(ge=1, le=1_000_000_000)]  # larger values would exceed any memory
Count = Annotated[int, Field(ge=0)]
Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
ZeroToOne = Annotated[float, Field(ge=0.0, le=1.0)]
Share = Annotated[float, Field(ge=0.0, lt=1.0)]
OFF = BeforeValidator(lambda value: "off" if value is False else value)  # YAML reads off as a boolean
PathOrUrl = Annotated[str, AfterValidator(paths.resolve_path_or_url)]  # a local path (~ is the user's home) or a URL
LocalPath = Annotated[str, AfterValidator(paths.resolve_local_path)]  # a local path
LocalPathOrBuiltin = Annotated[str, AfterValidator(paths.resolve_model_path)]  # a local path, or builtin:NAME


class Affects(Flag):
    """What a config key affects."""

    NOTHING = 0  # nothing but speed, paths and outputs
    LATENTS = auto()  # the content of a latent cache
    MEASURED = auto()  # the metrics of a validation; its clips are recorded separately
    RUN = auto()  # the result of training: a run cannot resume with another value
    PLAN = auto()  # the decisions of the planner
    CLIPS = LATENTS | MEASURED | RUN


class Section(BaseModel):
    """A group of config keys: frozen, and unknown keys are errors."""

    affects: ClassVar[Affects | None] = None  # for keys without an annotation; None: the same as the outer section

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    def check_rules(self, *rules: tuple[object, str]) -> Self:
        """Return the section, or raise an error if a rule is broken; called by validators.

        Args:
            rules: Pairs (is_broken, message).

        Raises:
            ValueError: A rule is broken; the message is that of the first broken rule.
        """
        for is_broken, message in rules:
            if is_broken:
                raise ValueError(message)
        return self


REPLAY_DATA = "replay.data"  # contains the keys of `data` that differ in the replay data set


@cache
def collect_effects(section: type[BaseModel]) -> Mapping[str, Affects]:
    """Return what each key of a section and of its inner sections affects, by dotted key.

    Raises:
        TypeError: A key has no annotation.
    """
    return dict(_iterate_effects(section, getattr(section, "affects", None), ""))


@cache
def get_effect(key: str, section: type[BaseModel]) -> Affects:
    """Return what a key affects.

    A part of a value, such as data.fields.cameras.left, affects the same as its key. For a section, the annotations of
    its keys are combined. The keys of `replay.data` are the same as those of `data`, but affect the run only.

    Raises:
        KeyError: There is no such key.
    """
    if (data_key := to_data_key(key)) != key:
        return get_effect(data_key, section) & Affects.RUN
    effects = ((f"{name}.", effect) for name, effect in collect_effects(section).items())
    matching = [effect for name, effect in effects if name.startswith(f"{key}.") or f"{key}.".startswith(name)]
    if not matching:
        raise KeyError(key)
    return reduce(or_, matching)


def to_data_key(key: str) -> str:
    """Return the key of `data` that a key of `replay.data` overrides; any other key is returned unchanged."""
    return f"data.{key.removeprefix(f'{REPLAY_DATA}.')}" if key.startswith(f"{REPLAY_DATA}.") else key


def values_that_affect(effects: Affects, section: BaseModel) -> dict[str, Any]:
    """Return the values of the keys that affect any of `effects`, as nested plain values.

    Raises:
        TypeError: A key has no annotation.
    """
    plain: dict[str, Any] = section.model_dump(mode="json")
    selected: dict[str, Any] = {}
    for key, effect in collect_effects(type(section)).items():
        *outer, name = key.split(".")
        values, target = plain, selected
        for part in outer:
            values = values.get(part) or {}
        if effects & effect and name in values:
            for part in outer:
                target = target.setdefault(part, {})
            target[name] = values[name]
    return selected


def _iterate_effects(section: type[BaseModel], outer: Affects | None, prefix: str) -> Iterator[tuple[str, Affects]]:
    for name, info in section.model_fields.items():
        annotation = next((entry for entry in info.metadata if isinstance(entry, Affects)), None)
        sections = [] if prefix + name == REPLAY_DATA else find_sections(info.annotation)
        for inner in (kind for base in sections for kind in [*getattr(base, "kinds", {}).values()] or [base]):
            candidates = (annotation, getattr(inner, "affects", None), outer)
            effect = next((candidate for candidate in candidates if candidate is not None), None)
            yield from _iterate_effects(inner, effect, f"{prefix}{name}.")
        if not sections:
            effect = outer if annotation is None else annotation
            if effect is None:
                raise TypeError(
                    f"{prefix}{name}: not annotated with what it affects, as in Annotated[int, Affects.RUN]"
                )
            yield prefix + name, effect


def find_sections(annotation: Any) -> list[type[BaseModel]]:
    """Return the sections that occur in a type annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [section for argument in get_args(annotation) for section in find_sections(argument)]


# ---- components ----

_FORMS = "a name, or {name: NAME, options: {...}}"


@dataclass(frozen=True)
class Component:
    """The name of a component in its registry, and the options that differ from the defaults."""

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)

    def plain(self) -> str | dict[str, Any]:
        """Return the component as plain values, as in a config file."""
        return {"name": self.name, "options": dict(self.options)} if self.options else self.name


@dataclass(frozen=True)
class ComponentOf:
    """The annotation of a config key that is a component, as in `Annotated[Component, ComponentOf(PLANNERS, "cem")]`.

    Reading a config checks the options with the `Config` class of the component.

    Args:
        registry: The registry of the components.
        default: The name to use if only options are given.
    """

    registry: Registry
    default: str | None = None

    def read(self, value: object) -> Component:
        """Parse a config value.

        Raises:
            ValueError: The value has another form, or the registry has no component of this name with these options.
        """
        values = value.plain() if isinstance(value, Component) else value
        values = {"name": values} if isinstance(values, str) else values
        mapping = values if isinstance(values, Mapping) else {}
        name, options = mapping.get("name", self.default), mapping.get("options", {})
        has_valid_keys = bool(mapping) and mapping.keys() <= {"name", "options"}
        if not has_valid_keys or not isinstance(name, str) or not isinstance(options, Mapping):
            raise ValueError(f"Input should be {_FORMS}")
        return Component(name, self.registry.changed_options(self.registry.require_registered(name), options))

    def __get_pydantic_core_schema__(self, _source: Any, _handler: Any) -> core_schema.CoreSchema:
        """Return the schema with which pydantic reads and writes the key."""
        plain = core_schema.plain_serializer_function_ser_schema(Component.plain)
        return core_schema.no_info_plain_validator_function(self.read, serialization=plain)

    def __get_pydantic_json_schema__(self, _schema: Any, _handler: Any) -> dict[str, Any]:
        """Return the JSON schema: the names of the components, and their options."""
        names = self.registry.names()
        with_options = [
            {
                "type": "object",
                "properties": {"name": {"const": name}, "options": section.model_json_schema()},
                "required": ["options"] if name == self.default else ["name"],
                "additionalProperties": False,
            }
            for name in names
            if (section := self.registry.options_class(name)) is not None
        ]
        return {"anyOf": [{"type": "string", **({"enum": names} if names else {})}, *with_options]}
