"""Registries of extension points: losses, planners, data formats and others, which a config selects by name.

Each registry finds objects by name. Built-in objects are listed here as `module:object` and imported on first use.
Installed packages provide objects as entry points of the registry's group. Modules that `plugins` in a config or
`--plugin` names register objects when they are imported. docs/extending.md has an example for each registry.
"""

from __future__ import annotations

import contextlib
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn, TypeVar

from pydantic import BaseModel, Field, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from vjepa2_ac.errors import InputError, did_you_mean

_Thing = TypeVar("_Thing")


class Registry:
    """Objects of one kind, by name.

    Args:
        kind: Name of the kind, for messages.
        group: Entry point group of installed packages.
        builtin: The objects of this package, each as `module:object` relative to the package.
    """

    def __init__(self, kind: str, group: str, builtin: Mapping[str, str]) -> None:
        self.kind, self.group = kind, group
        self._things: dict[str, Any] = {name: f"vjepa2_ac.{path}" for name, path in builtin.items()}
        self._origins: dict[str, str] = {**self._things}  # module:object of each registered object

    def register(self, name: str) -> Callable[[_Thing], _Thing]:
        """Return a decorator that registers a function, a class or an object under a name.

        Raises:
            InputError: Another object has this name. A module that is loaded again may register again.
        """
        caller = sys._getframe(1).f_globals["__name__"]

        def add(thing: _Thing) -> _Thing:
            path = getattr(thing, "__qualname__", "")  # instances have neither a qualified name nor a module
            origin = f"{getattr(thing, '__module__', caller) if path else caller}:{path}"
            if self._origins.setdefault(name, origin) != origin:
                problem = f"already registered by {_module(self._origins[name])}"
                raise InputError(where=f"{self.kind} {name!r}", found=problem, fix="Choose another name")
            _registered.append(_package(origin))
            self._things[name] = thing
            return thing

        return add

    def names(self) -> list[str]:
        """Return all names, built-in names first. Nothing is imported."""
        return list(dict.fromkeys([*self._things, *(entry.name for entry in installed_entry_points(self.group))]))

    def require_registered(self, name: str) -> str:
        """Return the name if it is registered.

        Raises:
            ValueError: The name is not registered; the message lists the registered names.
            InputError: Several packages have registered the name.
        """
        if name not in (names := self.names()):
            known = f"Expected one of {', '.join(map(repr, names))}" if names else "None is registered. Add its plugin"
            raise ValueError(f"no {self.kind} has this name. {did_you_mean(name, names)}{known}")
        origins = [
            self._origins.get(name),
            *(entry.value for entry in installed_entry_points(self.group) if entry.name == name),
        ]
        packages = {_package(origin): _module(origin) for origin in origins if origin}
        if len(packages) > 1:
            problem = f"registered by {' and by '.join(packages.values())}"
            raise InputError(where=f"{self.kind} {name!r}", found=problem, fix="Rename or uninstall all but one")
        return name

    def find(self, name: str) -> Any:
        """Return the object with a name; it is imported on first use.

        Raises:
            ValueError: The name is not registered.
        """
        thing = self._things.get(self.require_registered(name))
        if thing is None:
            thing = load_entry_point(next(entry for entry in installed_entry_points(self.group) if entry.name == name))
        elif isinstance(thing, str):
            module, _, attribute = thing.partition(":")
            thing = getattr(import_module(module), attribute)
        self._things[name] = thing
        return thing

    def options_class(self, name: str) -> type[BaseModel] | None:
        """Return the class of an object's options, its attribute `Config`; None without options."""
        return getattr(self.find(name), "Config", None)

    def options(self, name: str, values: Mapping[str, Any], *, at: tuple[str, ...] = ()) -> dict[str, BaseModel]:
        """Validate the options of an object, and return them as its keyword argument `options`; empty without options.

        Args:
            name: Name of the object.
            values: Its options.
            at: Location of the options relative to the validated config key, for messages.

        Raises:
            ValueError: The options are invalid, or the object has no options.
        """
        section = self.options_class(name)
        if section is not None:
            try:
                return {"options": section.model_validate(dict(values))}
            except ValidationError as error:
                raise _located(error, section, at) from None
        if values:
            raise ValueError(f"{self.kind} {name!r} has no options of its own, but {', '.join(values)} was set")
        return {}

    def changed_options(self, name: str, values: Mapping[str, Any]) -> dict[str, Any]:
        """Validate options, and return those that differ from the defaults.

        Built-in objects have a default for each option, so without options they are not imported.

        Raises:
            ValueError: As for `options`.
        """
        if not values and isinstance(self._things.get(name), str):
            return {}
        checked = self.options(name, values, at=("options",))
        changed = checked["options"].model_dump(exclude_defaults=True) if checked else {}
        return {key: values[key] for key in values if key in changed}

    def create(self, name: str, values: Mapping[str, Any]) -> Any:
        """Return the object with a name; for a class, an instance with these options.

        Raises:
            ValueError: As for `options`.
        """
        thing, options = self.find(name), self.options(name, values)
        return thing(**options) if isinstance(thing, type) else thing

    @property
    def options_schema(self) -> Any:
        """Field with the JSON schema of the options of all objects, for a config key that maps names to options."""

        def add(schema: dict[str, Any]) -> None:
            sections = {name: self.options_class(name) for name in self.names()}
            if sections:
                schema["properties"] = {
                    name: {} if section is None else section.model_json_schema() for name, section in sections.items()
                }
                schema["additionalProperties"] = False

        return Field(json_schema_extra=add)


def _located(error: ValidationError, section: type[BaseModel], at: tuple[str, ...]) -> ValidationError:
    """Return the errors of options with their location in the config; for unknown options with a suggestion."""
    lines = []
    for detail in error.errors(include_url=False):
        kind, text, location = detail["type"], detail["msg"], detail["loc"]
        if kind == "extra_forbidden":
            known = f"available: {', '.join(section.model_fields)}"
            suggestion = did_you_mean(str(location[-1]), section.model_fields)
            kind, text = UNKNOWN_OPTION, f"unknown key; {f'd{suggestion[1:-1]}' if suggestion else known}"
        custom = PydanticCustomError(kind, text)
        lines.append(InitErrorDetails(type=custom, loc=(*at, *location), input=detail["input"]))
    return ValidationError.from_exception_data(error.title, lines)


UNKNOWN_OPTION = "unknown_option"

SOURCES = Registry("data format", "vjepa2_ac.sources", {})
LOSSES = Registry(
    "loss",
    "vjepa2_ac.losses",
    {
        "l1": "model.distances:absolute_difference",
        "l2": "model.distances:squared_difference",
        "smooth_l1": "training.step:SmoothL1",
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
        "cosine": "planning.energy:cosine_distance",
    },
)
METRICS = Registry("metric", "vjepa2_ac.metrics", {"l1": "evaluation.result:L1", "l2": "evaluation.result:L2"})
TRACKERS = Registry("tracker", "vjepa2_ac.trackers", {})
TRANSFORMS = Registry("transform", "vjepa2_ac.transforms", {})
PLANNING_FILES = Registry(
    "planning file",
    "",  # no entry points
    {"prior": "policies.action_prior:load_prior_for_planning", "monitor": "policies.monitor:load_monitor_for_planning"},
)
"""Functions that read the files of `planning` keys; they are in packages outside of the core."""
TRAINING_HOOKS = Registry(
    "training hook",
    "",  # no entry points
    {
        "data.stride": "inspection.variants:choose_stride",
        "validation.decoder": "decoding.imagine:ValidationStrip",
        "motion": "inspection.motion:warnings_from_index",
        "coverage": "inspection.coverage:measure_coverage",
    },
)
"""Functions and classes outside of the core packages that training calls."""
REGISTRIES = (SOURCES, LOSSES, PLANNERS, ENERGIES, METRICS, TRACKERS, TRANSFORMS)


# ---- imports ----

_PACKAGE = "vjepa2_ac"
_registered: list[str] = []  # package of each registered object
_plugins: set[str] = set()  # imported modules that have registered an object


def installed_entry_points(group: str) -> EntryPoints:
    """Return the entry points of a group, without those of packages in the working directory."""
    with _installed_only():
        return _entry_points(group, tuple(sys.path))


@cache
def _entry_points(group: str, _path: tuple[str, ...]) -> EntryPoints:
    return entry_points(group=group)


def load_entry_point(entry_point: EntryPoint) -> Any:
    """Return the object of an entry point.

    Raises:
        InputError: The object cannot be imported.
    """
    with _installed_only():
        return _load_or_refuse(entry_point.load, f"{entry_point.name} = {entry_point.value}", entry_point.group)


def import_plugins(modules: Iterable[str], *, where: str, allow_local: bool = True) -> None:
    """Import modules that register objects.

    Args:
        modules: Names of the modules.
        where: Where the modules are named, for messages.
        allow_local: As for `import_user_module`.

    Raises:
        InputError: As for `import_user_module`; or a module registers nothing.
    """
    for module in modules:
        before = len(_registered)
        import_user_module(module, where=where, allow_local=allow_local)
        if len(_registered) > before or _package(module) in _registered:
            _plugins.add(module)
        if module not in _plugins:
            _refuse(module, where)


def import_user_module(module: str, *, where: str, allow_local: bool = True) -> ModuleType:
    """Import a module of the user.

    Args:
        module: Name of the module.
        where: Where the module is named, for messages.
        allow_local: Whether the module may be in the working directory. False for modules that a run names, because a
            run may be from a third party. Then only installed packages that mention this package are imported.

    Raises:
        InputError: There is no such module, or it cannot be imported.
    """
    parts = module.split(".")
    if not all(map(str.isidentifier, parts)) or "__main__" in parts or parts[0] == _PACKAGE:
        raise InputError(
            where=where, found=f"plugin {module!r}", needed="the name of your module, as in `import my_module`"
        )
    if module in sys.modules:
        return sys.modules[module]
    package = _package(module)
    with contextlib.nullcontext() if allow_local else _installed_only():
        if allow_local and find_spec(package) is None:
            sys.path.append(str(Path.cwd()))
        spec = find_spec(package)
        if spec is None:
            fix = (
                "Install it, or run the command in its folder"
                if allow_local
                else f"Install it, or add --plugin {module}"
            )
            raise InputError(where=where, found=f"plugin {module!r}: no such module", fix=fix)
        if not (allow_local or _mentions_this_package(spec)):
            _refuse(module, where)
        return _load_or_refuse(lambda: import_module(module), f"plugin {module!r}", where)


def _mentions_this_package(spec: ModuleSpec) -> bool:
    """Return whether a file of a package mentions this package, as all plugins do. Nothing is imported."""
    files = [Path(spec.origin)] if spec.has_location and spec.origin else []
    files += [file for folder in spec.submodule_search_locations or () for file in Path(folder).rglob("*.py")]
    return any(_PACKAGE.encode() in file.read_bytes() for file in files)


def _refuse(module: str, where: str) -> NoReturn:
    problem, needed = (
        f"plugin {module!r} registers nothing",
        "a module that registers a loss, a planner or another object",
    )
    raise InputError(where=where, found=problem, needed=needed, fix="See docs/extending.md for examples")


@contextlib.contextmanager
def _installed_only() -> Iterator[None]:
    """Within the context, import nothing from the working directory, which `python -m` puts first on the path."""
    before = sys.path[:]
    sys.path[:] = [path for path in before if not (Path(path).exists() and Path(path).samefile("."))]
    try:
        yield
    finally:
        sys.path[:] = [*before, *(path for path in sys.path if path not in before)]


def _load_or_refuse(load: Callable[[], _Thing], what: str, where: str) -> _Thing:
    """Return the result of `load`. Any exception becomes an `InputError` with the line of the plugin."""
    try:
        return load()
    except (Exception, SystemExit) as error:
        lines = [line for line in traceback.extract_tb(error.__traceback__) if "importlib" not in line.filename]
        location = next((f"; {line.filename}, line {line.lineno}" for line in lines if line.filename != __file__), "")
        cause = f"{type(error).__name__}: {error}".splitlines()[0]
        fix = "Correct or remove the plugin"
        raise InputError(where=where, found=f"{what} cannot be imported ({cause}{location})", fix=fix) from error


def _module(origin: str) -> str:
    return origin.partition(":")[0]


def _package(origin: str) -> str:
    return _module(origin).partition(".")[0]
