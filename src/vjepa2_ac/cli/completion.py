"""What a shell offers behind TAB, by argcomplete: commands, options, paths, models, configs and their keys."""

from __future__ import annotations

import argparse
from typing import Any

from argcomplete.completers import FilesCompleter
from argcomplete.finders import CompletionFinder


class _Completion(CompletionFinder):
    """Offers config keys where nothing else fits, too: argparse knows none behind an option."""

    def collect_completions(self, active_parsers: Any, parsed_args: Any, cword_prefix: str) -> list[str]:
        found = super().collect_completions(active_parsers, parsed_args, cword_prefix)
        return found or (_keys(cword_prefix) if len(active_parsers) > 1 and cword_prefix[:1].isalpha() else [])


def complete(parser: argparse.ArgumentParser) -> None:
    """Tell the shell that asks which words may stand at its cursor, and end the process."""
    _Completion()(parser, always_complete_options=False, default_completer=_words)  # type: ignore[arg-type] # any callable will do


def _words(prefix: str, action: argparse.Action, **_others: Any) -> list[str]:
    """Return what an argument without choices may be."""
    from vjepa2_ac.config.loading import packaged_configs

    named = str(action.metavar)
    if "key=value" in named:
        return _keys(prefix)
    configs = [f"builtin:{name}" for name in packaged_configs()] if "CONFIG" in named else []
    return [*configs, *["builtin:sim-tiny"] * ("MODEL" in named), *FilesCompleter()(prefix)]


def _keys(prefix: str) -> list[str]:
    """Return config keys and, as long as there are several, sections."""
    from vjepa2_ac.config.loading import all_keys

    sections = {key.rpartition(".")[0] for key in all_keys()}
    keys = [key for key in all_keys() if key.startswith(prefix) and key not in sections]
    heads = dict.fromkeys(key[: key.find(".", len(prefix)) + 1] or f"{key}=" for key in keys)
    return list(heads) if len(heads) > 1 else [f"{key}=" for key in keys]
