"""Doors for other people's code: what a config may name, here, in installed packages, and in modules of the user's.

A thing is found by its name in one of the registries below. This package's own are listed here as `module:object` and
imported when they are used; an installed package lists its own as entry points of the registry's group; a module that
`plugins` in a config or `--plugin` names registers its own when it is imported. docs/extending.md has a recipe of each.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

from pydantic import AfterValidator, BaseModel, Field, ValidationError, ValidationInfo
from pydantic_core import InitErrorDetails, PydanticCustomError

from vjepa2_ac.errors import InputError, did_you_mean

_Thing = TypeVar("_Thing")


class Registry:
    """Things of one kind, by name.

    Args:
        kind: What they are, in messages.
        group: The entry points of installed packages.
        own: Those of this package, each as `module:object` below it.
    """

    def __init__(self, kind: str, group: str, own: Mapping[str, str]) -> None:
        self.kind, self.group = kind, group
        self._things: dict[str, Any] = {name: f"vjepa2_ac.{place}" for name, place in own.items()}

    def register(self, name: str) -> Callable[[_Thing], _Thing]:
        """Return a decorator that adds a function or a class; a module that is imported twice may do so again."""

        def add(thing: _Thing) -> _Thing:
            self._things[name] = thing
            return thing

        return add

    def names(self) -> list[str]:
        """Return all names, those of this package first; nothing is imported."""
        return list(dict.fromkeys([*self._things, *(one.name for one in entry_points(group=self.group))]))

    def known(self, name: str) -> str:
        """Return a name that is registered; installed packages are only looked through for one that is not yet known.

        Raises:
            ValueError: It is not; names those that are.
        """
        if name not in self._things and name not in (names := self.names()):
            known = ", ".join(map(repr, names))
            raise ValueError(f"no {self.kind} of this name. {did_you_mean(name, names)}Known are {known}")
        return name

    def find(self, name: str) -> Any:
        """Return the thing of a name, imported now.

        Raises:
            ValueError: There is none.
        """
        thing = self._things.get(self.known(name))
        if thing is None:
            thing = next(one for one in entry_points(group=self.group) if one.name == name).load()
        elif isinstance(thing, str):
            module, _, attribute = thing.partition(":")
            thing = getattr(import_module(module), attribute)
        self._things[name] = thing
        return thing

    def section(self, name: str) -> type[BaseModel] | None:
        """Return the class of a thing's own options, its `Config`; None: it has none.

        What this package lists has its knobs in the config itself, and is not imported for this.
        """
        return None if isinstance(self._things.get(name), str) else getattr(self.find(name), "Config", None)

    def options(self, name: str, given: Mapping[str, Any], *, at: tuple[str, ...] = ()) -> dict[str, BaseModel]:
        """Return the checked options of a thing, as the keyword argument that it takes them by; empty: it has none.

        Args:
            name: The thing.
            given: Its options.
            at: Location of the options below the config key that is checked, for messages.

        Raises:
            ValueError: They are not what its `Config` says, or it has none.
        """
        section = self.section(name)
        if section is not None:
            try:
                return {"options": section.model_validate(dict(given))}
            except ValidationError as error:
                raise _located(error, section, at) from None
        if given:
            raise ValueError(f"{self.kind} {name!r} has no options of its own, and {', '.join(given)} is given")
        return {}

    def options_of(self, name: str) -> Any:
        """Return a check of a config key: it holds the options of the thing that the key `name` before it names."""

        def checked(given: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
            if name in info.data:  # else the name is wrong, which is reported there
                self.options(info.data[name], given)
            return given

        return AfterValidator(checked)

    def function(self, name: str, given: Mapping[str, Any]) -> Callable[..., Any]:
        """Return a function of a name; of a class an object that was made with its options.

        Raises:
            ValueError: As `options`.
        """
        found, options = self.find(name), self.options(name, given)
        made: Callable[..., Any] = found(**options) if isinstance(found, type) else found
        return made

    @property
    def name_in_schema(self) -> Any:
        """The names, as a JSON schema has them: for a knob that names one of these things."""
        return Field(json_schema_extra=lambda schema: schema.update({"enum": [*self.names()]} if self.names() else {}))

    @property
    def things_in_schema(self) -> Any:
        """The options of things by their names: for a knob that holds several of them."""

        def add(schema: dict[str, Any]) -> None:
            sections = {name: self.section(name) for name in self.names()}
            if sections:
                schema["properties"] = {
                    name: {} if section is None else section.model_json_schema() for name, section in sections.items()
                }
                schema["additionalProperties"] = False

        return Field(json_schema_extra=add)

    @property
    def options_in_schema(self) -> Any:
        """The options of things that have some, by the names of their classes: for the knob that holds them."""

        def add(schema: dict[str, Any]) -> None:
            sections = [section.model_json_schema() for name in self.names() if (section := self.section(name))]
            if sections:
                schema["anyOf"] = [*sections, {"type": "object", "maxProperties": 0}]

        return Field(json_schema_extra=add, validate_default=True)


def _located(error: ValidationError, section: type[BaseModel], at: tuple[str, ...]) -> ValidationError:
    """Return the errors of options at their location in the config; that of an unknown option names a known one."""
    lines = []
    for one in error.errors(include_url=False):
        kind, text, location = one["type"], one["msg"], one["loc"]
        if kind == "extra_forbidden":
            known = f"known here: {', '.join(section.model_fields)}"
            meant = did_you_mean(str(location[-1]), section.model_fields)
            kind, text = UNKNOWN_OPTION, f"unknown key; {f'd{meant[1:-1]}' if meant else known}"
        custom = PydanticCustomError(kind, text)
        lines.append(InitErrorDetails(type=custom, loc=(*at, *location), input=one["input"]))
    return ValidationError.from_exception_data(error.title, lines)


UNKNOWN_OPTION = "unknown_option"

SOURCES = Registry("form of data", "vjepa2_ac.sources", {})
LOSSES = Registry(
    "loss",
    "vjepa2_ac.losses",
    {
        "l1": "model.distances:absolute_difference",
        "l2": "model.distances:squared_difference",
        "smooth_l1": "training.loss:smooth_difference",
    },
)
PLANNERS = Registry(
    "planner",
    "vjepa2_ac.planners",
    {
        "cem": "planning.solvers:CemSolver",
        "icem": "planning.solvers:IcemSolver",
        "mppi": "planning.solvers:MppiSolver",
        "gradient": "planning.solvers:GradientSolver",
        "prior": "planning.solvers:PriorSolver",
    },
)
ENERGIES = Registry(
    "energy",
    "vjepa2_ac.energies",
    {
        "l1": "planning.energy:mean_difference",
        "l2": "planning.energy:mean_square",
        "cosine": "planning.energy:one_minus_cosine",
    },
)
METRICS = Registry("metric", "vjepa2_ac.metrics", {"l1": "evaluation.result:L1", "l2": "evaluation.result:L2"})
TRACKERS = Registry("tracker", "vjepa2_ac.trackers", {})
TRANSFORMS = Registry("transform", "vjepa2_ac.transforms", {})
REGISTRIES = (SOURCES, LOSSES, PLANNERS, ENERGIES, METRICS, TRACKERS, TRANSFORMS)


def import_plugins(modules: Iterable[str], *, where: str, here: bool = True) -> None:
    """Import the modules that register things.

    Args:
        modules: Their names, as `import` takes them.
        where: What names them, for messages.
        here: Whether one may lie in the working directory. Not where a run or a model names it, which may be a
            stranger's: its config imports what is installed, and nothing that came with it.

    Raises:
        InputError: One is not there, or fails.
    """
    for module in modules:
        try:
            if here and find_spec(module) is None:
                sys.path.append(str(Path.cwd()))
            import_module(module)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{module}.".startswith(f"{error.name}."):
                raise
            fix = "Install it, or run where it is" if here else f"Install it, or name it by --plugin {module}"
            raise InputError(where=where, found=f"plugin {module!r}: no such module", fix=fix) from None
