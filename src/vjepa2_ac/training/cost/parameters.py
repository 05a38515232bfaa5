"""Parameter counts: how many a model has, and which are trained. By arithmetic, as `flops`: no model is built."""

from __future__ import annotations

from dataclasses import dataclass

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.episode import EXTRINSICS_DIM
from vjepa2_ac.model.adapter.targets import ATTENTION, MLP, rank_of

CONDITIONS = 2  # tokens of a step besides its patches: action and state

_TUBELET = 2  # frames that the encoder's first layer takes at once


@dataclass(frozen=True)
class Parameters:
    """How many parameters there are, exactly."""

    encoder: int
    predictor: int
    trained: int  # an adapter's and whole heads beside it; or the whole predictor


@dataclass(frozen=True)
class Layer:
    """A linear layer of the predictor."""

    inputs: int
    outputs: int

    @property
    def weight(self) -> int:
        """Elements of its matrix."""
        return self.inputs * self.outputs


def count_parameters(config: Config, sizes: ModelSizes) -> Parameters:
    """Return how many parameters a model of these sizes has, and how many of them the config trains."""
    encoder = sizes.encoder
    patch = 3 * _TUBELET * sizes.patch_size**2
    block = 4 * (encoder.width + 1) * encoder.width + 4 * encoder.width
    hidden = int(encoder.width * encoder.mlp_ratio)
    block += (encoder.width + 1) * hidden + (hidden + 1) * encoder.width
    in_encoder = (patch + 1) * encoder.width + 2 * encoder.width + encoder.depth * block
    return Parameters(in_encoder, sum(_predictor_tensors(sizes)), sum(trained_tensors(config, sizes)))


def trained_tensors(config: Config, sizes: ModelSizes) -> list[int]:
    """Return the elements of each tensor that is trained."""
    if config.adapter.kind == "none":
        return _predictor_tensors(sizes, used_only=True)
    layers, found = linear_layers(sizes), []
    for name, rank in adapter_ranks(config, sizes).items():
        found += [rank * layers[name].inputs, rank * layers[name].outputs]
        found += [layers[name].outputs] if config.adapter.dora else []
    for name in config.adapter.modules_to_save:
        found += [layers[name].weight, layers[name].outputs]
    return found


def linear_layers(sizes: ModelSizes) -> dict[str, Layer]:
    """Return the linear layers of the predictor by name; the extrinsics' is there whether it is used or not."""
    width, latent = sizes.predictor.width, sizes.encoder.width
    hidden = int(width * sizes.predictor.mlp_ratio)
    layers = {
        "predictor_embed": Layer(latent, width),
        "action_encoder": Layer(sizes.predictor.action_dim, width),
        "state_encoder": Layer(sizes.predictor.state_dim, width),
        "extrinsics_encoder": Layer(EXTRINSICS_DIM, width),
    }
    for index in range(sizes.predictor.depth):
        layers |= {f"blocks.{index}.attn.{name}": Layer(width, width) for name in ATTENTION}
        layers[f"blocks.{index}.mlp.fc1"] = Layer(width, hidden)
        layers[f"blocks.{index}.mlp.fc2"] = Layer(hidden, width)
    layers["predictor_proj"] = Layer(width, latent)
    return layers


def adapter_ranks(config: Config, sizes: ModelSizes) -> dict[str, int]:
    """Return the layers that get an adapter, by name, with the rank of each; none where all is trained."""
    adapter = config.adapter
    if adapter.kind == "none":
        return {}
    names = [name for name in linear_layers(sizes) if sizes.predictor.use_extrinsics or name != "extrinsics_encoder"]
    everything = {_last(name) for name in names} - set(adapter.modules_to_save)
    sets = {"attention": ATTENTION, "mlp": MLP, "all": tuple(everything)}
    targets = {layer for target in adapter.targets for layer in sets.get(target, (target,))}
    return {name: rank_of(adapter, name) for name in names if _last(name) in targets}


def _predictor_tensors(sizes: ModelSizes, *, used_only: bool = False) -> list[int]:
    """Return the elements of each tensor of the predictor."""
    norms = [sizes.predictor.width] * 2 * (2 * sizes.predictor.depth + 1)
    layers = linear_layers(sizes)
    if used_only and not sizes.predictor.use_extrinsics:
        del layers["extrinsics_encoder"]
    return [size for layer in layers.values() for size in (layer.weight, layer.outputs)] + norms


def _last(name: str) -> str:
    return name.rsplit(".", 1)[-1]
