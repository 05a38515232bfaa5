"""The model card of an exported adapter: base, data, training, metrics and usage."""

from __future__ import annotations

import math
from pathlib import PurePath

from huggingface_hub import EvalResult, ModelCardData
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from safetensors import safe_open

from vjepa2_ac import __version__
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.evaluation.result import Row
from vjepa2_ac.model.adapter.adapter_folder import LORA_WEIGHTS
from vjepa2_ac.model.adapter.lora import trainable_report
from vjepa2_ac.model.network.input_heads import widths_as_text, widths_of_model
from vjepa2_ac.reports.metrics_json import Metrics
from vjepa2_ac.runs.checkpoint import ADAPTER, read_state
from vjepa2_ac.runs.loading import TrainedRun

_ERROR = "rollout.l1.over_persistence.{}"  # the key of a row, by horizon


def model_card(run: TrainedRun, name: str, evaluation: Metrics | None, plot: str | None) -> str:
    """Return the README.md of an adapter, in Markdown, with the Hub's front matter.

    Args:
        run: Whose adapter it is.
        name: Of the run.
        evaluation: What `vjepa2-ac evaluate` wrote.
        plot: Name of the figure beside the card.

    Raises:
        TemplateError: The template does not fit.
    """
    config, model = run.config, run.world_model
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
        run=run,
        name=name,
        evaluation=evaluation,
        plot=plot,
        base=model.adaptation,
        heads=None if model.fresh_heads is None else widths_of_model(model.sizes),
        takes=widths_as_text(model.sizes),
        steps=read_state(run.checkpoint).step,
        trained=_trained(run),
        version=__version__,
        front=_front(run, name, evaluation),
        loss=_loss(config),
        adapter_words=_adapter(config),
        curves=[] if evaluation is None else _curves(evaluation),
        rankings={} if evaluation is None else _rankings(evaluation),
        base_arguments=_base_arguments(config),
        every_setting=config_as_yaml(config.model_copy(update={"run_dir": name})),
    )


def _trained(run: TrainedRun) -> str:
    """Return the number of trained parameters as text."""
    with safe_open(run.checkpoint / ADAPTER / LORA_WEIGHTS, framework="pt") as file:
        shapes = [file.get_slice(name).get_shape() for name in file.keys()]  # noqa: SIM118  # no iterator
    return str(trainable_report(run.world_model)._replace(trained=sum(map(math.prod, shapes))))


def _front(run: TrainedRun, name: str, evaluation: Metrics | None) -> str:
    """Return what the Hub reads of a card: tags, and the errors of the adapter as results of an evaluation."""
    card = ModelCardData(
        library_name="peft",
        pipeline_tag="robotics",
        tags=["v-jepa-2-ac", "world-model", "lora"],
        model_name=name,
        eval_results=None if evaluation is None else _eval_results(run, evaluation),
    )
    return str(card.to_yaml())


def _eval_results(run: TrainedRun, measured: Metrics) -> list[EvalResult] | None:
    """Return the rollout errors of this very checkpoint; None where it was not measured."""
    about = measured.about
    if about.checkpoint_path != run.checkpoint.name:
        return None
    return [
        EvalResult(
            task_type="robotics",
            task_name="prediction of latents",
            dataset_type=run.config.data.source,
            dataset_name=PurePath(run.config.data.path).name,
            dataset_split=about.split,
            metric_type="l1_over_persistence",
            metric_name=f"L1 error over persistence, {step * about.seconds_per_step:.2f} s ahead",
            metric_value=round(row.value, 4),
        )
        for step in range(1, about.frames)
        if (row := measured.of(_ERROR.format(step))) is not None and math.isfinite(row.value)
    ]


def _rankings(evaluation: Metrics) -> dict[str, Row]:
    """Return the mean rank of the true action, by model."""
    found = {name: evaluation.of("ranking.rank", name) for name in evaluation.models}
    return {name: row for name, row in found.items() if row is not None}


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


def _curves(measured: Metrics) -> list[list[Row | None]]:
    """Return the errors over persistence of all models at each horizon."""
    steps = range(1, measured.about.frames)
    return [[measured.of(_ERROR.format(step), name) for name in measured.models] for step in steps]


def _ratio(row: Row | None) -> str:
    return "not measured" if row is None else str(row.estimate)


def _base_arguments(config: Config) -> str:
    words = [repr(config.model.base), f"dtype={config.model.dtype!r}"]
    sizes = config.model.sizes.model_dump(mode="json", exclude_defaults=True)
    words += [f"sizes=ModelSizes.model_validate({sizes!r})"] if sizes else []
    if config.model.encoder is not None:
        told = config.model.encoder.model_dump(mode="json", exclude_defaults=True)
        only_path = told.keys() == {"path"}
        words.append(f"encoder={told['path']!r}" if only_path else f"encoder=EncoderConfig.model_validate({told!r})")
    return ", ".join(words)


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' * (number != 1)}"
