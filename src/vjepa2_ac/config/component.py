"""Components by name, with options of their own: `planner: icem`, or `planner: {name: icem, options: {elites: 20}}`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic_core import core_schema

from vjepa2_ac.registry import Registry

_FORMS = "a name, or {name: NAME, options: {...}}"


@dataclass(frozen=True)
class Component:
    """The name of a component in its registry, and those of its options that are not the defaults."""

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)

    def plain(self) -> str | dict[str, Any]:
        """Return the component as a config file holds it."""
        return {"name": self.name, "options": dict(self.options)} if self.options else self.name


@dataclass(frozen=True)
class ComponentOf:
    """Marks a config key that holds a component, as in `Annotated[Component, ComponentOf(PLANNERS, "cem")]`.

    The options are checked by the `Config` class of the component when the config is read.

    Args:
        registry: Of the components.
        usual: The name that is meant where only options are given.
    """

    registry: Registry
    usual: str | None = None

    def read(self, value: object) -> Component:
        """Return the component that a config value means.

        Raises:
            ValueError: The value has another form, or the registry has no component of this name with these options.
        """
        values = value.plain() if isinstance(value, Component) else value
        values = {"name": values} if isinstance(values, str) else values
        form = values if isinstance(values, Mapping) else {}
        name, options = form.get("name", self.usual), form.get("options", {})
        is_known = bool(form) and form.keys() <= {"name", "options"}
        if not is_known or not isinstance(name, str) or not isinstance(options, Mapping):
            raise ValueError(f"{_FORMS} is expected")
        return Component(name, self.registry.changed_options(self.registry.known(name), options))

    def __get_pydantic_core_schema__(self, _source: Any, _handler: Any) -> core_schema.CoreSchema:
        """Return the schema by which pydantic reads and writes the key."""
        plain = core_schema.plain_serializer_function_ser_schema(Component.plain)
        return core_schema.no_info_plain_validator_function(self.read, serialization=plain)

    def __get_pydantic_json_schema__(self, _schema: Any, _handler: Any) -> dict[str, Any]:
        """Return the JSON schema: the names, and the options of each component that has some."""
        names = self.registry.names()
        with_options = [
            {
                "type": "object",
                "properties": {"name": {"const": name}, "options": section.model_json_schema()},
                "required": ["options"] if name == self.usual else ["name"],
                "additionalProperties": False,
            }
            for name in names
            if (section := self.registry.section(name)) is not None
        ]
        return {"anyOf": [{"type": "string", **({"enum": names} if names else {})}, *with_options]}
