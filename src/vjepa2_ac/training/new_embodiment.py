"""Checks for a new robot: does the model accept its states and actions, and which layers learn them?"""

from __future__ import annotations

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.loading import base_sizes
from vjepa2_ac.model.network.input_heads import fit_heads, heads_to_replace, require_trained
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import Reporter


def check_heads(config: Config, dataset: Dataset) -> None:
    """Refuse, before the model is loaded, data of other widths than the base's if no layer would learn them.

    Raises:
        InputError: A new head would not be trained; or the stride is to be chosen by the base, which cannot predict
            from this data.
    """
    heads = heads_to_replace(base_sizes(config.model), dataset.widths)
    if heads and config.data.stride == "auto":
        widths = dataset.widths
        raise InputError(
            where="data.stride",
            found=f"auto, for states of {widths.state} and actions of {widths.action} numbers",
            needed="widths that the base knows: it is asked at which stride it predicts best",
            fix="Set data.stride to a number of control steps",
        )
    require_trained(heads, config.adapter)


def fit_to_data(world_model: WorldModel, config: Config, dataset: Dataset, reporter: Reporter) -> None:
    """Give a base new input heads if the data's states or actions have other widths, and report them.

    Args:
        world_model: The base, without an adapter.
        config: The config of the run; its seed initializes the heads.
        dataset: The data.
        reporter: Receives a message for each new head, and for each head that takes vectors and stays..

    Raises:
        InputError: A new head would not be trained.
    """
    heads = heads_to_replace(world_model.sizes, dataset.widths)
    require_trained(heads, config.adapter)
    for line in fit_heads(world_model, dataset.widths, config.seed):
        reporter.note(line)
    trained = config.adapter.kind == "none" or config.model.random is not None
    for name in ("state_encoder", "action_encoder") if world_model.sizes.predictor.use_states else ("action_encoder",):
        if config.data.states == "vector" and name not in {*heads, *config.adapter.modules_to_save} and not trained:
            reporter.note(
                f"{name.replace('_', ' ')}: the base's own, as wide as the data. If its numbers mean something else"
                f" than those the base was trained on, add {name} to adapter.modules_to_save"
            )


NOT_ASKED = (
    "The base is not asked whether it is better than persistence: with fresh input heads it predicts little until they"
    " are trained."
)
