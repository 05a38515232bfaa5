"""The model card of an exported adapter: base, data, training, metrics and usage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

from huggingface_hub import EvalResult, ModelCardData
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from vjepa2_ac import __version__
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.episode import Widths


@dataclass(frozen=True)
class AdapterFacts:
    """The content of a card besides the settings of its run."""

    name: str
    steps: int  # optimizer steps done
    checkpoint: str  # name of the checkpoint that is exported
    chosen: str  # the same, and whether it is the newest or the best
    trained: str  # number of trained parameters, as text
    base_predictor: str  # fingerprints
    base_encoder: str
    evaluation: Mapping[str, Any] | None  # what `vjepa2-ac evaluate` wrote
    plot: str | None  # name of the file beside the card
    fresh_heads: Widths | None = None  # of states and actions, if the base's input heads were replaced


def model_card(config: Config, facts: AdapterFacts) -> str:
    """Return the README.md of an adapter, in Markdown, with the Hub's front matter.

    Raises:
        KeyError: The evaluation lacks a metric; likewise TemplateError, and TypeError if one is of another type.
    """
    card = Environment(  # Markdown is not escaped
        loader=PackageLoader("vjepa2_ac", "assets"),
        undefined=StrictUndefined,
        autoescape=select_autoescape(),
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    card.filters |= {"code": lambda name: f"`{name}`", "count": _count, "ratio": _ratio}
    return card.get_template("model_card.md.jinja").render(
        **dict(config),
        facts=facts,
        heads=facts.fresh_heads,
        version=__version__,
        front=_front(config, facts),
        loss=_loss(config),
        adapter_words=_adapter(config),
        curves=[] if facts.evaluation is None else _curves(facts.evaluation),
        base_arguments=_base_arguments(config),
        every_setting=config_as_yaml(config.model_copy(update={"run_dir": facts.name})),
    )


def _front(config: Config, facts: AdapterFacts) -> str:
    """Return what the Hub reads of a card: tags, and the errors of the adapter as results of an evaluation."""
    card = ModelCardData(
        library_name="peft",
        pipeline_tag="robotics",
        tags=["v-jepa-2-ac", "world-model", "lora"],
        model_name=facts.name,
        eval_results=_eval_results(config, facts),
    )
    return str(card.to_yaml())


def _eval_results(config: Config, facts: AdapterFacts) -> list[EvalResult] | None:
    """Return the rollout errors of this very checkpoint; None where it was not measured."""
    measured = facts.evaluation
    if measured is None or measured["about"]["checkpoint_path"] != facts.checkpoint:
        return None
    about, models = measured["about"], measured["models"]
    ratios = models[list(models)[-1]]["rollout"]["l1"]["over_persistence"]  # what was measured comes last
    return [
        EvalResult(
            task_type="robotics",
            task_name="prediction of latents",
            dataset_type=config.data.source,
            dataset_name=PurePath(config.data.path).name,
            dataset_split=about["split"],
            metric_type="l1_over_persistence",
            metric_name=f"L1 error over persistence, {step * about['seconds_per_step']:.2f} s ahead",
            metric_value=round(ratio["value"], 4),
        )
        for step, ratio in enumerate(ratios, start=1)
        if ratio["value"] is not None
    ]


def _loss(config: Config) -> str:
    training = config.training
    parts = {"teacher forcing": training.teacher_forcing_weight}
    parts[f"rollout of {_count(training.rollout_steps, 'step')}"] = training.rollout_weight
    words = [name if weight == 1 else f"{weight:g} x {name}" for name, weight in parts.items() if weight]
    return f"{training.loss}, {' + '.join(words)}"


def _adapter(config: Config) -> str:
    adapter = config.adapter
    words = [f"rank {adapter.rank}", f"alpha {adapter.alpha:g}", f"dropout {adapter.dropout:g}"]
    words.append("rsLoRA" if adapter.rslora else "plain scale")
    words += ["DoRA"] * adapter.dora
    words += [f"started as {adapter.init}"] * (adapter.init != "default")
    words += ["other ranks or alphas for some layers"] * bool(adapter.rank_pattern or adapter.alpha_pattern)
    words += [f"`{name}` trained whole" for name in adapter.modules_to_save]
    return ", ".join(words)


def _curves(measured: Mapping[str, Any]) -> list[tuple[Mapping[str, Any], ...]]:
    """Return the errors over persistence of all models at each horizon."""
    by_model = [model["rollout"]["l1"]["over_persistence"] for model in measured["models"].values()]
    return list(zip(*by_model, strict=True))


def _ratio(ratio: Mapping[str, Any]) -> str:
    interval = "" if ratio["low"] is None else f" [{ratio['low']:.3f}, {ratio['high']:.3f}]"
    return f"{ratio['value']:.3f}{interval}"


def _base_arguments(config: Config) -> str:
    words = [repr(config.model.base), f"dtype={config.model.dtype!r}"]
    sizes = config.model.sizes.model_dump(mode="json", exclude_defaults=True)
    return ", ".join([*words, f"sizes=ModelSizes.model_validate({sizes!r})"] if sizes else words)


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' * (number != 1)}"
