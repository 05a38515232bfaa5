"""The pages that are made of the code: commands, config keys, the public names, configs and results."""

from __future__ import annotations

import argparse
import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import vjepa2_ac
from site_links import ROOT, on_site
from vjepa2_ac.cli.program import _make_parser
from vjepa2_ac.config.loading import config_path, config_schema, packaged_configs

_COLUMNS = "88"  # of a help text
_REFERENCE = {  # page: what it has; below these, all that the code makes
    "made/commands": "all commands, a line each, and what each `--help` prints",
    "made/config_keys": "every config key with its range and default",
    "made/configs": "the configs of the package, whole",
    "made/api": "the public names of Python",
    "made/examples": "the scripts of `examples/`, whole",
    "extending": "how to add a loss, a planner, a metric, a data source or a robot",
    "data_reference": "data formats in detail, checks, splits, caches",
    "training_reference": "files of a run, metrics of a step, adapters, replay, GPU options",
    "evaluation_reference": "every number, and `metrics.json`",
    "decoding_reference": "decoders, what images can show, image metrics",
    "planning_reference": "energies, solvers, axes, closed loop, `plan.json`",
    "serving_reference": "messages, access, records",
    "encoders_reference": "cost of each encoder, keys of weights, what is rejected",
}
_PROJECT = {
    "made/results": "tables that commands of the repository write",
    "published_figures": "commands that reproduce published results",
    "IMPLEMENTATION_NOTES": "how it works, and how exactness is checked",
    "decisions": "what was decided, and why",
    "made/changelog": "what changed for users",
    "made/contributing": "set-up, tests, architecture, rules",
    "releasing": "the steps of a release",
    "made/security": "what is trusted, and how to report a vulnerability",
}
_BOUNDS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}


def write_pages(folder: Path) -> None:
    """Write all pages that are made, in place of those that are there; files that stay the same are not touched."""
    pages = {
        "commands.md": commands_page(),
        "config_keys.md": keys_page(),
        "api.md": api_page(),
        "configs.md": configs_page(),
        "examples.md": examples_page(),
        **dict(results_pages()),
        "reference.md": contents_page("Reference", _REFERENCE),
        "project.md": contents_page("Project", _PROJECT),
        "readme.txt": on_site((ROOT / "README.md").read_text(encoding="utf-8"), "README.md", "index.md"),
        **{f"{name.lower()}.md": _of_the_root(f"{name}.md") for name in ("CHANGELOG", "CONTRIBUTING", "SECURITY")},
    }
    folder.mkdir(exist_ok=True)
    for old in folder.rglob("*.md"):
        if str(old.relative_to(folder)) not in pages:
            old.unlink()  # of an earlier build
    for name, text in pages.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def contents_page(title: str, pages: Mapping[str, str]) -> str:
    """Return a page that lists others, and has them below it in the menu."""
    links = [f"- {{doc}}`/{page}`: {about}" for page, about in pages.items()]
    entries = [f"/{page}" for page in pages]
    return "\n".join([f"# {title}", "", *links, "", "```{toctree}", ":hidden:", "", *entries, "```", ""])


def commands_page() -> str:
    """Return a section for each command, with what `--help` prints."""
    os.environ["COLUMNS"] = _COLUMNS
    leaves = {" ".join(words): parser for words, parser in _leaves(_make_parser(), ())}
    lines = ["# Every command", "", "As `vjepa2-ac COMMAND --help` prints them; [TAB completes](../start.md) them.", ""]
    lines += [f"- [{name}](#{name.replace(' ', '-')}): {_first_sentence(one)}" for name, one in leaves.items()]
    for name, parser in leaves.items():
        lines += ["", f"## {name}", "", "```text", parser.format_help().strip(), "```"]
    return "\n".join([*lines, ""])


def keys_page() -> str:
    """Return a table for each section of a config: key, type and range, default, and what it does."""
    schema = config_schema()
    kinds = schema["properties"]["data"].get("oneOf", [])
    lines = [
        "# Config keys", "",
        "Every key with its type, range and default, from the schema (`vjepa2-ac config schema`).", "",
    ]  # fmt: skip
    lines += _section("", schema, schema, depth=2)
    for kind in kinds:
        lines += _own_sections(_resolved(kind, schema), schema)
    return "\n".join(lines)


def api_page() -> str:
    """Return the public names, each described by its docstring."""
    lines = ["# Public names", "", "`from vjepa2_ac import …`; [shapes and units](../python.md).", ""]
    for name in vjepa2_ac.__all__:
        kind = "autoclass" if name[0].isupper() else "autofunction"
        members = ["   :members:"] if name == "Controller" else []
        lines += [f"## {name}", "", "```{eval-rst}", f".. {kind}:: vjepa2_ac.{name}", *members, "```", ""]
    return "\n".join(lines)


def configs_page() -> str:
    """Return the configs that come with the package, whole."""
    lines = [
        "# Configs of the package",
        "",
        "`vjepa2-ac config text builtin:NAME > my.yaml` begins one of your own.",
        "",
    ]
    for name, about in packaged_configs().items():
        text = config_path(f"builtin:{name}").read_text(encoding="utf-8")
        lines += [f"## {name}", "", f"{about}.", "", "```yaml", text.strip(), "```", ""]
    return "\n".join(lines)


def examples_page() -> str:
    """Return the scripts in `examples/`, whole."""
    lines = ["# Examples", "", "They run on a fresh clone, without a download, unless they say otherwise.", ""]
    for path in sorted((ROOT / "examples").rglob("*.py")):
        name = path.relative_to(ROOT)
        lines += [f"## {name}", "", "```python", path.read_text(encoding="utf-8").strip(), "```", ""]
    return "\n".join(lines)


def results_pages() -> Iterator[tuple[str, str]]:
    """Yield the pages of measured results, and one that lists them."""
    names = []
    for path in (*(ROOT / "benchmarks/results").glob("*.md"), *sorted((ROOT / "evidence/results").glob("*.md"))):
        text = path.read_text(encoding="utf-8")
        names.append(path.stem)
        heading = "" if text.startswith("# ") else f"# {path.stem.replace('_', ' ').capitalize()}\n\n"
        yield (
            f"results/{path.name}",
            heading + on_site(text, str(path.relative_to(ROOT)), f"made/results/{path.name}"),
        )
    entries = "\n".join(f"results/{name}" for name in names)
    text = "Tables that commands of the repository write."
    yield "results.md", f"# Results\n\n{text}\n\n```{{toctree}}\n{entries}\n```\n"


def _of_the_root(name: str) -> str:
    """Return a page that is a file of the repository's root."""
    return on_site((ROOT / name).read_text(encoding="utf-8"), name, f"made/{name.lower()}")


def _leaves(
    parser: argparse.ArgumentParser, words: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], argparse.ArgumentParser]]:
    inner = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
    if not inner:
        yield words, parser
    for one in inner:
        for name, below in one.choices.items():
            yield from _leaves(below, (*words, name))


def _first_sentence(parser: argparse.ArgumentParser) -> str:
    """Return what a command does, in short: the beginning of its description, as Markdown."""
    found = re.match(r".*?[^.](?=[.;]\s|[.]?$)", re.sub(r"\s+", " ", parser.description or ""))
    return re.sub(r"([<>*_\[\]|])", r"\\\1", found[0]) if found else ""


def _resolved(one: Mapping[str, Any], schema: Mapping[str, Any]) -> Mapping[str, Any]:
    name = one.get("$ref", "").rpartition("/")[2]
    return schema["$defs"][name] if name else one


def _section(prefix: str, section: Mapping[str, Any], schema: Mapping[str, Any], *, depth: int) -> list[str]:
    """Return the table of a section, then those of the sections within."""
    rows, inner = [], []
    for name, one in section.get("properties", {}).items():
        found = _section_of(one, schema)
        for part in _components_with_options(one):
            title = f"{prefix}{name}, options of {part['name']['const']}"
            inner.append((title, part["options"], part["options"].get("description", "")))
        of_items = _section_of(one.get("items") or {}, schema)  # of a list of sections
        if of_items is not None:
            inner.append((f"{prefix}{name}", of_items, f"{_about(one)} A list; each item has these keys."))
        if found is None:
            rows.append(f"| `{prefix}{name}` | {_kind(one, schema)} | {_default(one)} | {_about(one)} |")
        else:
            inner.append((f"{prefix}{name}", found, _about(one)))
    lines = []
    if rows:
        lines += ["| key | values | default | |", "|---|---|---|---|", *rows, ""]
    for key, found, about in inner:
        if key == "replay.data":
            lines += [f"{'#' * min(depth, 4)} {key}", "", f"{about} Its keys are those of [data](#data).", ""]
            continue
        keys = f"{key.partition(',')[0]}.options." if ", options of " in key else f"{key}."
        lines += [f"{'#' * min(depth, 4)} {key}", "", about, "", *_section(keys, found, schema, depth=depth + 1)]
    return lines


def _components_with_options(one: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the name and the options of each component with options that a key may hold."""
    properties = [option.get("properties", {}) for option in one.get("anyOf", [])]
    return [part for part in properties if "const" in part.get("name", {})]


def _section_of(one: Mapping[str, Any], schema: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the section that a key holds, None for a value; of several forms of data the first one."""
    for option in [one, *one.get("anyOf", []), *one.get("allOf", []), *one.get("oneOf", [])]:
        found = _resolved(option, schema)
        if "properties" in found and found["properties"].keys() != {"name", "options"}:  # a component is a value
            return found
    return None


def _own_sections(kind: Mapping[str, Any], schema: Mapping[str, Any]) -> list[str]:
    """Return the sections that one form of data has and the first has not."""
    source = kind["properties"]["source"].get("const") or kind["properties"]["source"].get("default")
    first = _resolved(schema["properties"]["data"]["oneOf"][0], schema)["properties"]
    lines = []
    for name, one in kind["properties"].items():
        if name not in first and (found := _section_of(one, schema)):
            lines += [f"## data.{name} (source: {source})", "", *_section(f"data.{name}.", found, schema, depth=3)]
    return lines


def _kind(one: Mapping[str, Any], schema: Mapping[str, Any]) -> str:
    one = _resolved(one, schema)
    if "enum" in one:
        return ", ".join(f"`{value}`" for value in one["enum"])
    if "const" in one:
        return f"`{one['const']}`"
    if options := one.get("anyOf"):
        return " or ".join(dict.fromkeys(_kind(option, schema) for option in options))
    bounds = "".join(f" {sign} {one[name]:,}" for name, sign in _BOUNDS.items() if name in one)
    if one.get("type") == "array":
        parts = one.get("prefixItems") or [one.get("items", {})]
        return f"list of {', '.join(dict.fromkeys(_kind(part, schema) for part in parts))}"
    return {"null": "null", "object": "mapping"}.get(one.get("type", ""), one.get("type", "any")) + bounds


def _default(one: Mapping[str, Any]) -> str:
    if "default" not in one:
        return ""
    default = one["default"]
    if isinstance(default, dict) and default.get("options") == {}:
        default = default["name"]  # of a component
    text = json.dumps(default)
    return f"`{text if len(text) < 80 else text[:76] + ' …'}`"


def _about(one: Mapping[str, Any]) -> str:
    return re.sub(r"\s+", " ", one.get("description", "")).replace("|", "\\|")
