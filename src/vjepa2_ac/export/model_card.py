"""The model card of an exported adapter: base, data, training, metrics and usage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

from huggingface_hub import EvalResult, ModelCardData

from vjepa2_ac import __version__
from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.episode import Widths

_NOT_EVALUATED = (
    "**Not evaluated**: there was no `metrics.json` in the run when this card was written. Nothing is known of how"
    " good this adapter is."
)


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
        KeyError: The evaluation lacks a metric; likewise TypeError if one is of another type.
    """
    parts = [
        f"---\n{_front(config, facts)}\n---\n\n# {facts.name}: a LoRA adapter for V-JEPA 2-AC",
        f"Written by vjepa2-ac {__version__} from checkpoint {facts.chosen} of the run.",
        _base(config, facts),
        _data(config, facts),
        _training(config, facts),
        _results(facts),
        _use(config, facts.fresh_heads),
        f"## Every setting\n\n```yaml\n{config_as_yaml(config.model_copy(update={'run_dir': facts.name}))}```",
    ]
    return "\n\n".join(parts) + "\n"


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


def _base(config: Config, facts: AdapterFacts) -> str:
    return _list(
        "Base",
        {
            "base": f"`{config.model.base}`, frozen, in {config.model.dtype}",
            "fingerprint of its predictor": f"`{facts.base_predictor}`",
            "fingerprint of its encoder": f"`{facts.base_encoder}`",
        },
    )


def _states(config: Config, facts: AdapterFacts) -> dict[str, str]:
    data = config.data
    if data.states == "pose":
        return {"poses": f"in the frame of the {'robot base' if data.pose_frame == 'base' else data.pose_frame}"}
    joined = f", joined by {data.join_actions}" if data.join_actions else ""
    lines = {"states": "the robot's own numbers", "actions": f"{data.actions}{joined}"}
    if facts.fresh_heads is not None:
        state, action = facts.fresh_heads
        lines["input heads"] = f"fresh, for states of {state} and actions of {action} numbers; trained whole"
    return lines


def _data(config: Config, facts: AdapterFacts) -> str:
    data = config.data
    return _list(
        "Data",
        {
            "source": f"{data.source}, `{data.path}`",
            "camera": ", ".join(f"`{name}`" for name in data.cameras),
            "clips": f"{data.frames} frames, one every {data.stride} control steps (the stride)",
            "crop": data.crop,
            **_states(config, facts),
            "held out": f"{data.validation_share:.0%} of the episodes for validation, {data.test_share:.0%} for test"
            + ("" if data.split_by is None else f", those of one `{data.split_by}` together"),
            **_replay(config),
        },
    )


def _replay(config: Config) -> dict[str, str]:
    if config.replay is None:
        return {}
    share, data = config.replay.share, config.replay.data
    return {"replay": f"{share:.0%} of the training clips from {data.source}, `{data.path}`"}


def _training(config: Config, facts: AdapterFacts) -> str:
    training, adapter = config.training, config.adapter
    return _list(
        "Training",
        {
            "steps": f"{facts.steps:,} of {training.steps:,} planned",
            "clips per step": f"batch {training.batch_size} x accumulation {training.accumulation} on each device",
            "learning rate": f"{training.learning_rate:g}, {training.schedule}",
            "warm-up": _count(training.warmup_steps, "step"),
            "loss": _loss(config),
            "optimizer": f"{training.optimizer}, weight decay {training.weight_decay:g}",
            "precision": training.precision,
            "seed": f"{config.seed}",
            "adapter": _adapter(config),
            "layers": ", ".join(f"`{target}`" for target in adapter.targets),
            "size": facts.trained,
        },
    )


def _loss(config: Config) -> str:
    training = config.training
    parts = {"teacher forcing": training.teacher_forcing_weight}
    parts[f"rollout of {_count(training.rollout_steps, 'step')}"] = training.rollout_weight
    parts[f"contrast of actions (margin {training.action_contrast.margin:g})"] = training.action_contrast.weight
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


def _results(facts: AdapterFacts) -> str:
    """Return what was measured, and of which checkpoint: it may be an older one."""
    if facts.evaluation is None:
        return f"## Results\n\n{_NOT_EVALUATED}"
    measured = facts.evaluation
    lines = ["## Results", "", measured["verdict"], ""]
    about, clips = measured["about"], measured["clips"]
    if about["checkpoint_path"] != facts.checkpoint:
        lines += [f"**Measured on another checkpoint**: `{about['checkpoint_path']}`, not `{facts.checkpoint}`.", ""]
    where = (
        f"Split {about['split']}: {_count(clips['count'], 'clip')} of {_count(clips['episodes'], 'episode')}. L1"
        " error of the rollout over that of copying the first frame (1: as good as doing nothing), with a 95 %"
        " interval over episodes:"
    )
    lines += [where, "", *_table(measured)]
    return "\n".join(lines) + (f"\n\n![Error by horizon]({facts.plot})" if facts.plot else "")


def _table(measured: Mapping[str, Any]) -> list[str]:
    models = measured["models"]
    columns = [models[name]["rollout"]["l1"]["over_persistence"] for name in models]
    seconds = measured["about"]["seconds_per_step"]
    rows = [
        f"| {(step + 1) * seconds:.2f} s | " + " | ".join(_ratio(one) for one in ratios) + " |"
        for step, ratios in enumerate(zip(*columns, strict=True))
    ]
    return [f"| ahead | {' | '.join(models)} |", f"|---{'|---' * len(models)}|", *rows]


def _ratio(ratio: Mapping[str, Any]) -> str:
    interval = "" if ratio["low"] is None else f" [{ratio['low']:.3f}, {ratio['high']:.3f}]"
    return f"{ratio['value']:.3f}{interval}"


def _use(config: Config, fresh_heads: Widths | None) -> str:
    return f"""## Use

With vjepa2-ac, which checks that the base is the one it was trained on:

```python
{_imports(config)}
model = load_model({_base_arguments(config)}, adapter="FOLDER")  # the folder of this card
```

{_use_with_peft(config, fresh_heads)}"""


def _imports(config: Config) -> str:
    sizes = "" if config.model.sizes == ModelSizes() else "from vjepa2_ac.config import ModelSizes\n"
    return f"from vjepa2_ac import load_model\n{sizes}"


def _base_arguments(config: Config) -> str:
    words = [repr(config.model.base), f"dtype={config.model.dtype!r}"]
    sizes = config.model.sizes.model_dump(mode="json", exclude_defaults=True)
    return ", ".join([*words, f"sizes=ModelSizes.model_validate({sizes!r})"] if sizes else words)


def _use_with_peft(config: Config, fresh_heads: Widths | None) -> str:
    if config.adapter.init == "pissa":
        return (
            "PEFT alone cannot use it: an adapter that started as PiSSA belongs to a base from which `pissa_start` was"
            " taken off, which `load_model` does."
        )
    return f"""With PEFT's own loading and the imports above, on the predictor of that base{_with_heads(fresh_heads)}:

```python
from peft import PeftModel

{_peft_lines(config, fresh_heads)}
```"""


def _with_heads(fresh_heads: Widths | None) -> str:
    return "" if fresh_heads is None else ", whose input heads have other widths and must be replaced first"


def _peft_lines(config: Config, fresh_heads: Widths | None) -> str:
    load = f"load_model({_base_arguments(config)})"
    if fresh_heads is None:
        return f'base = {load}\npredictor = PeftModel.from_pretrained(base.predictor, "FOLDER")'
    state, action = fresh_heads
    return f"""from vjepa2_ac.episode import Widths
from vjepa2_ac.model.network.input_heads import fit_heads

base = {load}
fit_heads(base, Widths(state={state}, action={action}), seed=0)
predictor = PeftModel.from_pretrained(base.predictor, "FOLDER")"""


def _list(title: str, entries: Mapping[str, str]) -> str:
    return f"## {title}\n\n" + "\n".join(f"- {name}: {value}" for name, value in entries.items())


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' * (number != 1)}"
