"""Doors for other people's code: what a config may name, here, in installed packages, and in modules of the user's.

A thing is found by its name in one of the registries below. This package's own are listed here as `module:object` and
imported when they are used; an installed package lists its own as entry points of the registry's group; a module that
`plugins` in a config or `--plugin` names registers its own when it is imported. docs/extending.md has a recipe of each.
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
    """Things of one kind, by name.

    Args:
        kind: What they are, in messages.
        group: The entry points of installed packages.
        own: Those of this package, each as `module:object` below it.
    """

    def __init__(self, kind: str, group: str, own: Mapping[str, str]) -> None:
        self.kind, self.group = kind, group
        self._things: dict[str, Any] = {name: f"vjepa2_ac.{place}" for name, place in own.items()}
        self._origins: dict[str, str] = {**self._things}  # module:object of what has registered itself

    def register(self, name: str) -> Callable[[_Thing], _Thing]:
        """Return a decorator that adds a function, a class or an object.

        Raises:
            InputError: Something else is registered by this name. A module that is loaded again may register again.
        """
        caller = sys._getframe(1).f_globals["__name__"]

        def add(thing: _Thing) -> _Thing:
            path = getattr(thing, "__qualname__", "")  # an object has none, and does not know its module
            origin = f"{getattr(thing, '__module__', caller) if path else caller}:{path}"
            if self._origins.setdefault(name, origin) != origin:
                found = f"registered by {_module(self._origins[name])} already"
                raise InputError(where=f"{self.kind} {name!r}", found=found, fix="Choose another name")
            _registered.append(_package(origin))
            self._things[name] = thing
            return thing

        return add

    def names(self) -> list[str]:
        """Return all names, those of this package first; nothing is imported."""
        return list(dict.fromkeys([*self._things, *(one.name for one in installed(self.group))]))

    def known(self, name: str) -> str:
        """Return a name that is registered.

        Raises:
            ValueError: It is not; the message lists the names that are.
            InputError: Several packages have registered it.
        """
        if name not in (names := self.names()):
            known = f"Known are {', '.join(map(repr, names))}" if names else "None is registered: is its plug-in named?"
            raise ValueError(f"no {self.kind} of this name. {did_you_mean(name, names)}{known}")
        origins = [self._origins.get(name), *(one.value for one in installed(self.group) if one.name == name)]
        packages = {_package(origin): _module(origin) for origin in origins if origin}
        if len(packages) > 1:
            found = f"registered by {' and by '.join(packages.values())}"
            raise InputError(where=f"{self.kind} {name!r}", found=found, fix="Rename or uninstall all but one")
        return name

    def find(self, name: str) -> Any:
        """Return the thing of a name, imported now.

        Raises:
            ValueError: There is none.
        """
        thing = self._things.get(self.known(name))
        if thing is None:
            thing = load_installed(next(one for one in installed(self.group) if one.name == name))
        elif isinstance(thing, str):
            module, _, attribute = thing.partition(":")
            thing = getattr(import_module(module), attribute)
        self._things[name] = thing
        return thing

    def section(self, name: str) -> type[BaseModel] | None:
        """Return the class of a thing's own options, its `Config`; None: it has none."""
        return getattr(self.find(name), "Config", None)

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

    def changed_options(self, name: str, given: Mapping[str, Any]) -> dict[str, Any]:
        """Check options, and return those that are not the defaults.

        Things of this package have a default for each option: without options they are not imported.

        Raises:
            ValueError: As `options`.
        """
        if not given and isinstance(self._things.get(name), str):
            return {}
        checked = self.options(name, given, at=("options",))
        changed = checked["options"].model_dump(exclude_defaults=True) if checked else {}
        return {key: given[key] for key in given if key in changed}

    def make(self, name: str, given: Mapping[str, Any]) -> Any:
        """Return the thing of a name; of a class an object that was made with its options.

        Raises:
            ValueError: As `options`.
        """
        found, options = self.find(name), self.options(name, given)
        return found(**options) if isinstance(found, type) else found

    @property
    def options_schema(self) -> Any:
        """The options of things by their names: for a knob that holds several of them."""

        def add(schema: dict[str, Any]) -> None:
            sections = {name: self.section(name) for name in self.names()}
            if sections:
                schema["properties"] = {
                    name: {} if section is None else section.model_json_schema() for name, section in sections.items()
                }
                schema["additionalProperties"] = False

        return Field(json_schema_extra=add)


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
        "cosine": "planning.energy:one_minus_cosine",
    },
)
METRICS = Registry("metric", "vjepa2_ac.metrics", {"l1": "evaluation.result:L1", "l2": "evaluation.result:L2"})
TRACKERS = Registry("tracker", "vjepa2_ac.trackers", {})
TRANSFORMS = Registry("transform", "vjepa2_ac.transforms", {})
PLANNING_FILES = Registry(
    "file of planning",
    "",  # no entry points
    {"prior": "policies.action_prior:load_prior_for_planning", "monitor": "policies.monitor:load_monitor_for_planning"},
)
"""Readers of the files that `planning` names and that packages beside the core make."""
TRAINING_HOOKS = Registry(
    "hook of training",
    "",  # no entry points
    {
        "data.stride": "inspection.variants:choose_stride",
        "validation.decoder": "decoding.imagine:ValidationStrip",
        "motion": "inspection.motion:warnings_from_index",
        "coverage": "inspection.coverage:coverage_in",
    },
)
"""Functions and classes of packages beside the core that training calls."""
REGISTRIES = (SOURCES, LOSSES, PLANNERS, ENERGIES, METRICS, TRACKERS, TRANSFORMS)


# ---- imports ----

_US = "vjepa2_ac"
_registered: list[str] = []  # packages, one for each thing that was registered
_plugins: set[str] = set()  # modules that were imported and have registered something


def installed(group: str) -> EntryPoints:
    """Return the entry points of a group. Packages in the working directory are not installed."""
    with _installed_only():
        return _entry_points(group, tuple(sys.path))


@cache
def _entry_points(group: str, _path: tuple[str, ...]) -> EntryPoints:
    return entry_points(group=group)


def load_installed(entry_point: EntryPoint) -> Any:
    """Return the object of an entry point.

    Raises:
        InputError: It cannot be imported.
    """
    with _installed_only():
        return _imported(entry_point.load, f"{entry_point.name} = {entry_point.value}", entry_point.group)


def import_plugins(modules: Iterable[str], *, where: str, here: bool = True) -> None:
    """Import the modules that register things.

    Args:
        modules: Their names, as `import` takes them.
        where: What names them, for messages.
        here: As for `import_user_module`.

    Raises:
        InputError: As `import_user_module`; or a module registers nothing.
    """
    for module in modules:
        before = len(_registered)
        import_user_module(module, where=where, here=here)
        if len(_registered) > before or _package(module) in _registered:
            _plugins.add(module)
        if module not in _plugins:
            _refuse(module, where)


def import_user_module(module: str, *, where: str, here: bool = True) -> ModuleType:
    """Return a module of the user's.

    Args:
        module: Its name, as `import` takes it.
        where: What names it, for messages.
        here: Whether it may be in the working directory. False where a run names it, which may be a third party's:
            then only installed packages that mention this one are imported.

    Raises:
        InputError: There is no such module, or it cannot be imported.
    """
    parts = module.split(".")
    if not all(map(str.isidentifier, parts)) or "__main__" in parts or parts[0] == _US:
        raise InputError(where=where, found=f"plugin {module!r}", needed="a module of yours, as in `import my_module`")
    if module in sys.modules:
        return sys.modules[module]
    package = _package(module)
    with contextlib.nullcontext() if here else _installed_only():
        if here and find_spec(package) is None:
            sys.path.append(str(Path.cwd()))
        spec = find_spec(package)
        if spec is None:
            fix = "Install it, or run where it is" if here else f"Install it, or name it by --plugin {module}"
            raise InputError(where=where, found=f"plugin {module!r}: no such module", fix=fix)
        if not (here or _mentions_us(spec)):
            _refuse(module, where)
        return _imported(lambda: import_module(module), f"plugin {module!r}", where)


def _mentions_us(spec: ModuleSpec) -> bool:
    """Return whether the files of a package mention this one, as all do that register something; imports nothing."""
    files = [Path(spec.origin)] if spec.has_location and spec.origin else []
    files += [file for folder in spec.submodule_search_locations or () for file in Path(folder).rglob("*.py")]
    return any(_US.encode() in file.read_bytes() for file in files)


def _refuse(module: str, where: str) -> NoReturn:
    found, needed = f"plugin {module!r} registers nothing", "a module that registers a loss, a planner, …"
    raise InputError(where=where, found=found, needed=needed, fix="docs/extending.md has a recipe for each")


@contextlib.contextmanager
def _installed_only() -> Iterator[None]:
    """Import nothing from the working directory, within the context: `python -m` puts it first."""
    before = sys.path[:]
    sys.path[:] = [path for path in before if not (Path(path).exists() and Path(path).samefile("."))]
    try:
        yield
    finally:
        sys.path[:] = [*before, *(path for path in sys.path if path not in before)]


def _imported(load: Callable[[], _Thing], what: str, where: str) -> _Thing:
    """Return what is imported; any exception becomes one error with the line of the plug-in."""
    try:
        return load()
    except (Exception, SystemExit) as error:
        lines = [one for one in traceback.extract_tb(error.__traceback__) if "importlib" not in one.filename]
        place = next((f"; {one.filename}, line {one.lineno}" for one in lines if one.filename != __file__), "")
        cause = f"{type(error).__name__}: {error}".splitlines()[0]
        fix = "Correct or leave out the plug-in"
        raise InputError(where=where, found=f"{what} cannot be imported ({cause}{place})", fix=fix) from error


def _module(origin: str) -> str:
    return origin.partition(":")[0]


def _package(origin: str) -> str:
    return _module(origin).partition(".")[0]
