"""Write the pages that are generated from the code: commands, config keys, public names, configs and results."""

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

_COLUMNS = "88"  # width of help texts
_REFERENCE = {  # page: its description
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
    "predecessor": "the first public fine-tuning of the released model, repeated in the simulator",
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
    """Write all generated pages, and delete pages of earlier builds. Unchanged files are not written."""
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
        **{f"{name.lower()}.md": _root_page(f"{name}.md") for name in ("CHANGELOG", "CONTRIBUTING", "SECURITY")},
    }
    folder.mkdir(exist_ok=True)
    for path in folder.rglob("*.md"):
        if str(path.relative_to(folder)) not in pages:
            path.unlink()
    for name, text in pages.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def contents_page(title: str, pages: Mapping[str, str]) -> str:
    """Return a page that lists other pages, and contains them in its menu."""
    links = [f"- {{doc}}`/{page}`: {about}" for page, about in pages.items()]
    entries = [f"/{page}" for page in pages]
    return "\n".join([f"# {title}", "", *links, "", "```{toctree}", ":hidden:", "", *entries, "```", ""])


def commands_page() -> str:
    """Return the page of all commands, with the output of `--help` for each command."""
    os.environ["COLUMNS"] = _COLUMNS
    parsers = {" ".join(words): parser for words, parser in _find_commands(_make_parser(), ())}
    lines = ["# Every command", "", "As `vjepa2-ac COMMAND --help` prints them; [TAB completes](../start.md) them.", ""]
    lines += [f"- [{name}](#{name.replace(' ', '-')}): {_first_sentence(parser)}" for name, parser in parsers.items()]
    for name, parser in parsers.items():
        lines += ["", f"## {name}", "", "```text", parser.format_help().strip(), "```"]
    return "\n".join([*lines, ""])


def keys_page() -> str:
    """Return the page of all config keys: a table for each section with key, type and range, default, description."""
    schema = config_schema()
    kinds = schema["properties"]["data"].get("oneOf", [])
    lines = [
        "# Config keys", "",
        "Every key with its type, range and default, from the schema (`vjepa2-ac config schema`).", "",
    ]  # fmt: skip
    lines += _section("", schema, schema, depth=2)
    for kind in kinds:
        lines += _own_sections(_resolve(kind, schema), schema)
    return "\n".join(lines)


def api_page() -> str:
    """Return the page of all public names with their docstrings."""
    lines = ["# Public names", "", "`from vjepa2_ac import …`; [shapes and units](../python.md).", ""]
    for name in vjepa2_ac.__all__:
        kind = "autoclass" if name[0].isupper() else "autofunction"
        members = ["   :members:"] if name == "Controller" else []
        lines += [f"## {name}", "", "```{eval-rst}", f".. {kind}:: vjepa2_ac.{name}", *members, "```", ""]
    return "\n".join(lines)


def configs_page() -> str:
    """Return the page with the complete text of the package's configs."""
    lines = [
        "# Configs of the package",
        "",
        "`vjepa2-ac config text builtin:NAME > my.yaml` copies a config, as a start for your own.",
        "",
    ]
    for name, about in packaged_configs().items():
        text = config_path(f"builtin:{name}").read_text(encoding="utf-8")
        lines += [f"## {name}", "", f"{about}.", "", "```yaml", text.strip(), "```", ""]
    return "\n".join(lines)


def examples_page() -> str:
    """Return the page with the complete text of the scripts in `examples/`."""
    lines = ["# Examples", "", "The scripts run on a fresh clone without a download, unless noted otherwise.", ""]
    for path in sorted((ROOT / "examples").rglob("*.py")):
        name = path.relative_to(ROOT)
        lines += [f"## {name}", "", "```python", path.read_text(encoding="utf-8").strip(), "```", ""]
    return "\n".join(lines)


def results_pages() -> Iterator[tuple[str, str]]:
    """Yield the pages of measured results, and the page that lists them."""
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


def _root_page(name: str) -> str:
    """Return the page of a file in the repository's root."""
    return on_site((ROOT / name).read_text(encoding="utf-8"), name, f"made/{name.lower()}")


def _find_commands(
    parser: argparse.ArgumentParser, words: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], argparse.ArgumentParser]]:
    """Yield the words and the parser of each command without sub-commands."""
    actions = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not actions:
        yield words, parser
    for action in actions:
        for name, subparser in action.choices.items():
            yield from _find_commands(subparser, (*words, name))


def _first_sentence(parser: argparse.ArgumentParser) -> str:
    """Return the first sentence of a command's description, as Markdown."""
    match = re.match(r".*?[^.](?=[.;]\s|[.]?$)", re.sub(r"\s+", " ", parser.description or ""))
    return re.sub(r"([<>*_\[\]|])", r"\\\1", match[0]) if match else ""


def _resolve(node: Mapping[str, Any], schema: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a node of the schema, or the definition that it refers to."""
    name = node.get("$ref", "").rpartition("/")[2]
    return schema["$defs"][name] if name else node


def _section(prefix: str, section: Mapping[str, Any], schema: Mapping[str, Any], *, depth: int) -> list[str]:
    """Return the table of a section, followed by the tables of its sub-sections."""
    rows, inner = [], []
    for name, node in section.get("properties", {}).items():
        subsection = _section_of(node, schema)
        for part in _components_with_options(node):
            title = f"{prefix}{name}, options of {part['name']['const']}"
            inner.append((title, part["options"], part["options"].get("description", "")))
        item_section = _section_of(node.get("items") or {}, schema)
        if item_section is not None:
            inner.append((f"{prefix}{name}", item_section, f"{_about(node)} A list; each item has these keys."))
        if subsection is None:
            rows.append(f"| `{prefix}{name}` | {_kind(node, schema)} | {_default(node)} | {_about(node)} |")
        else:
            inner.append((f"{prefix}{name}", subsection, _about(node)))
    lines = []
    if rows:
        lines += ["| key | values | default | |", "|---|---|---|---|", *rows, ""]
    for key, subsection, about in inner:
        if key == "replay.data":
            lines += [f"{'#' * min(depth, 4)} {key}", "", f"{about} Its keys are those of [data](#data).", ""]
            continue
        keys = f"{key.partition(',')[0]}.options." if ", options of " in key else f"{key}."
        lines += [f"{'#' * min(depth, 4)} {key}", "", about, "", *_section(keys, subsection, schema, depth=depth + 1)]
    return lines


def _components_with_options(node: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the name and the options of each component with options that is a possible value of a key."""
    properties = [option.get("properties", {}) for option in node.get("anyOf", [])]
    return [part for part in properties if "const" in part.get("name", {})]


def _section_of(node: Mapping[str, Any], schema: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the section of a key, for several data formats the first section; None if the key has a value."""
    for option in [node, *node.get("anyOf", []), *node.get("allOf", []), *node.get("oneOf", [])]:
        section = _resolve(option, schema)
        if "properties" in section and section["properties"].keys() != {"name", "options"}:  # a component is a value
            return section
    return None


def _own_sections(kind: Mapping[str, Any], schema: Mapping[str, Any]) -> list[str]:
    """Return the sections of a data format that the first data format does not have."""
    source = kind["properties"]["source"].get("const") or kind["properties"]["source"].get("default")
    first = _resolve(schema["properties"]["data"]["oneOf"][0], schema)["properties"]
    lines = []
    for name, node in kind["properties"].items():
        if name not in first and (section := _section_of(node, schema)):
            lines += [f"## data.{name} (source: {source})", "", *_section(f"data.{name}.", section, schema, depth=3)]
    return lines


def _kind(node: Mapping[str, Any], schema: Mapping[str, Any]) -> str:
    """Return the possible values of a key as text: type and range, or a list of values."""
    node = _resolve(node, schema)
    if "enum" in node:
        return ", ".join(f"`{value}`" for value in node["enum"])
    if "const" in node:
        return f"`{node['const']}`"
    if options := node.get("anyOf"):
        return " or ".join(dict.fromkeys(_kind(option, schema) for option in options))
    bounds = "".join(f" {sign} {node[name]:,}" for name, sign in _BOUNDS.items() if name in node)
    if node.get("type") == "array":
        parts = node.get("prefixItems") or [node.get("items", {})]
        return f"list of {', '.join(dict.fromkeys(_kind(part, schema) for part in parts))}"
    return {"null": "null", "object": "mapping"}.get(node.get("type", ""), node.get("type", "any")) + bounds


def _default(node: Mapping[str, Any]) -> str:
    if "default" not in node:
        return ""
    default = node["default"]
    if isinstance(default, dict) and default.get("options") == {}:
        default = default["name"]  # a component without options
    text = json.dumps(default)
    return f"`{text if len(text) < 80 else text[:76] + ' …'}`"


def _about(node: Mapping[str, Any]) -> str:
    return re.sub(r"\s+", " ", node.get("description", "")).replace("|", "\\|")
