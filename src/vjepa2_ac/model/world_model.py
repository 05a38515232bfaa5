"""The world model (encoder and predictor): encode, predict, roll out, save and load.

`fit_heads` adds new input layers for robots whose states or actions have other widths than in the base model; these
layers must be trained.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from vjepa2_ac.config import AdapterConfig, ModelSizes
from vjepa2_ac.episode import Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.blocks import initialise
from vjepa2_ac.model.encoder import ENCODE_CHUNK, Encoder
from vjepa2_ac.model.model_files import CONFIG, FORMAT, PUBLISHED_HEADS, EncoderOrigin, read_encoder_origin, read_sizes
from vjepa2_ac.model.predictor import LatentDynamics, new_predictor, normalise_latents
from vjepa2_ac.storage import folder_writer
from vjepa2_ac.storage.tensors import read_tensors, save_tensors

ENCODER, PREDICTOR = "encoder.safetensors", "predictor/model.safetensors"


@dataclass(frozen=True)
class Adaptation:
    """The adaptation of the predictor by `model.lora`."""

    kind: Literal["lora", "none"]  # as in config.AdapterConfig; none: all weights are trained
    base: str  # fingerprint of the predictor before training
    encoder: str  # fingerprint of the encoder
    start: dict[str, Tensor] | None = None  # with kind none: the weights before training


class Fingerprints(NamedTuple):
    """Hashes of a model's weights."""

    encoder: str
    base: str  # the predictor before it was adapted
    predictor: str  # the predictor with the trained weights


@dataclass(frozen=True)
class NewInputHeads:
    """New input layers of the predictor (`fit_heads`), for states or actions of other widths than the base model's."""

    replaced: dict[str, Tensor]  # the weights of the base model's layers, by their names in the predictor
    seed: int  # seed of the new layers


class RemovedEncoder(nn.Module):
    """A placeholder for a removed encoder."""

    def __init__(self, fingerprint: str) -> None:
        super().__init__()
        self.fingerprint = fingerprint  # of the removed encoder


class WorldModel(LatentDynamics):
    """A frozen encoder and an action-conditioned predictor.

    Latents and predictions are layer-normalised over `dim` without affine parameters, and are float32 for weights of
    any data type. `model.lora.add_adapter` selects the weights to train; without it all weights are frozen.

    Create one with `random`, `from_pretrained` or `model.checkpoints.load_official`.
    """

    def __init__(self, sizes: ModelSizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.encoder: Encoder | RemovedEncoder = Encoder(sizes)
        self.predictor: nn.Module = new_predictor(sizes)
        self.predictor.requires_grad_(False)
        self.adaptation: Adaptation | None = None
        self.new_input_heads: NewInputHeads | None = None
        self.merged_from: Fingerprints | None = None  # fingerprints before an adapter was merged
        self.encoder_origin: EncoderOrigin | None = None  # None if the encoder was loaded together with the predictor

    @classmethod
    def random(
        cls,
        sizes: ModelSizes,
        seed: int,
        dtype: torch.dtype = torch.float32,
        *,
        near_persistence: bool = False,
        device: torch.device | str = "cpu",
    ) -> WorldModel:
        """Return a randomly initialised model, with the same weights for the same sizes, seed and device type.

        Weights are drawn as in the released recipe; with `near_persistence` the predictor starts close to persistence.
        They are drawn on the device; for the full size this takes half a minute on one CPU core.
        """
        model = cls.empty(sizes).to_empty(device=device)
        generator = torch.Generator(device).manual_seed(seed)
        model.loaded_encoder.initialise(generator)
        model.draw_predictor(generator, dtype, near_persistence=near_persistence)
        return model.to(dtype)

    def draw_predictor(self, generator: torch.Generator, dtype: torch.dtype, *, near_persistence: bool = False) -> None:
        """Initialise the predictor on the generator's device; its current weights may be on the meta device."""
        predictor = self.base_predictor.to_empty(device=generator.device)
        predictor.initialise(generator)
        if near_persistence:
            predictor.initialise_near_persistence(generator)
        predictor.to(dtype)

    @classmethod
    def empty(cls, sizes: ModelSizes) -> WorldModel:
        """Return a model in eval mode without weights (on the meta device), into which weights can be loaded."""
        with torch.device("meta"):
            return cls(sizes).eval()

    @classmethod
    def from_pretrained(cls, folder: str | Path, dtype: torch.dtype | None = None) -> WorldModel:
        """Load a model from a folder written by `save_pretrained`; `dtype` None keeps the data type of each file.

        Raises:
            InputError: The folder is not a world model, is incomplete or damaged.
        """
        folder = Path(folder)
        model = cls.empty(read_sizes(folder))
        model.encoder_origin = read_encoder_origin(folder)
        needed, fix = "the weights of a world model", "Copy or write the folder again"
        for part, name in ((model.encoder, ENCODER), (model.predictor, PREDICTOR)):
            weights = read_tensors(folder / name, part.state_dict(), needed=needed, fix=fix, dtype=dtype)
            part.load_state_dict(weights, assign=True)
        return model

    def save_pretrained(self, folder: str | Path) -> None:
        """Save the model as config.json, encoder.safetensors and predictor/ (which transformers can load).

        The files are written into a temporary folder and then moved, config.json last, so that a folder with a
        config.json is complete.

        Raises:
            InputError: The folder is not writable.
            ValueError: The model has an adapter (merge it first, or save it with `adapter_folder.save_trained`), or the
                encoder was removed.
        """
        if self.predictor is not self.base_predictor:
            raise ValueError(
                "the model has an adapter: merge it with merge_adapter, or save only the adapter with save_trained"
            )
        card: dict[str, Any] = {"format": FORMAT, "sizes": self.sizes.model_dump(mode="json")}
        if self.encoder_origin is not None:
            card["encoder_origin"] = self.encoder_origin.as_dict()
        encoder = self.loaded_encoder
        predictor: Any = self.predictor
        with folder_writer(Path(folder), CONFIG) as fresh:
            (fresh / PREDICTOR).parent.mkdir()
            save_tensors(encoder.state_dict(), fresh / ENCODER)
            save_tensors(predictor.state_dict(), fresh / PREDICTOR)
            predictor.config.architectures = [type(predictor).__name__]
            predictor.config.save_pretrained(fresh / "predictor")
            (fresh / CONFIG).write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")

    @property
    def image_size(self) -> int:
        """The height and width of a frame in pixels."""
        return self.sizes.image_size

    @property
    def num_tokens(self) -> int:
        """The number of tokens per frame."""
        return self.sizes.tokens_per_frame

    @property
    def latent_dim(self) -> int:
        """The width of a latent."""
        return self.sizes.encoder.width

    @property
    def loaded_encoder(self) -> Encoder:
        """The encoder.

        Raises:
            ValueError: The encoder was removed.
        """
        if isinstance(self.encoder, Encoder):
            return self.encoder
        raise ValueError("the encoder was removed, because latents come from a cache")

    def remove_encoder(self) -> None:
        """Remove the encoder's weights permanently, because latents come from a cache. The fingerprint is kept."""
        if isinstance(self.encoder, Encoder):
            self.encoder = RemovedEncoder(self.encoder_fingerprint())

    @torch.no_grad()
    def encode(
        self, frames: Float[Tensor, "batch time 3 height width"], chunk: int = ENCODE_CHUNK
    ) -> Float[Tensor, "batch time tokens dim"]:
        """Return the latents of normalised frames, each frame encoded independently.

        Args:
            frames: Frames normalised as in training (ImageNet mean and std).
            chunk: Number of frames per forward pass of the encoder; limits the memory.

        Raises:
            ValueError: The frames have another size than `image_size`; or the encoder was removed.
        """
        features = normalise_latents(self.loaded_encoder(frames.flatten(0, 1), chunk))
        return rearrange(features, "(batch time) tokens dim -> batch time tokens dim", batch=len(frames))

    def encoder_fingerprint(self) -> str:
        """Return a hash of the encoder's tensors and other properties, which is part of the key of cached latents."""
        if isinstance(self.encoder, RemovedEncoder):
            return self.encoder.fingerprint
        tensors, properties = fingerprint(self.encoder.state_dict()), self.encoder_properties
        if not properties:
            return tensors
        return hashlib.sha256(json.dumps([tensors, properties], sort_keys=True).encode()).hexdigest()

    @property
    def encoder_properties(self) -> dict[str, str | int]:
        """The properties on which latents depend, but which the tensors do not determine.

        Empty for tubelets of V-JEPA 2 with the published number of heads, and for a model created with its encoder.
        """
        sizes, origin, properties = self.sizes.encoder, self.encoder_origin, dict[str, str | int]()
        if sizes.family != "v2":
            properties |= {"encoder.family": sizes.family, "encoder.frame": sizes.frame}
        if origin is not None and origin.has_heads_in_fingerprint and PUBLISHED_HEADS.get(sizes.width) != sizes.heads:
            properties["encoder.heads"] = sizes.heads
        return properties

    @property
    def encoder_description(self) -> str:
        """A description of the encoder and its origin, for cards."""
        sizes, frame = self.sizes.encoder, ""
        if sizes.family != "v2":
            frame = f", each frame as {'a tubelet' if sizes.frame == 'tubelet' else 'an image'}"
        origin = f"; from {self.encoder_origin}" if self.encoder_origin else ""
        return f"V-JEPA {sizes.family[1:]}, {sizes.depth} blocks of {sizes.width}, {sizes.heads} heads{frame}{origin}"

    def fingerprints(self) -> Fingerprints:
        """Return the hashes of base and trained weights; for a merged model those before the merge."""
        if self.merged_from is not None:
            return self.merged_from
        adaptation, predictor = self.adaptation, fingerprint(self.predictor.state_dict())
        if adaptation is not None:
            return Fingerprints(adaptation.encoder, adaptation.base, predictor)
        return Fingerprints(self.encoder_fingerprint(), self.predictor_fingerprint(), predictor)

    def predictor_fingerprint(self) -> str:
        """Return a hash of the base model's predictor, independent of an adapter and of new input layers."""
        replaced = {} if self.new_input_heads is None else self.new_input_heads.replaced
        return fingerprint(base_weights(self.base_predictor) | replaced)


def fingerprint(weights: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of names, shapes and values rounded to bfloat16.

    Because of the rounding it is the same for a checkpoint loaded as float32 or as bfloat16.
    """
    digest = hashlib.sha256()
    for name, value in sorted(weights.items()):
        digest.update(f"{name} {tuple(value.shape)}\n".encode())
        rounded = value.detach().to("cpu", torch.bfloat16).contiguous()
        digest.update(rounded.view(torch.uint8).numpy().data)
    return digest.hexdigest()


def base_weights(predictor: nn.Module) -> dict[str, Tensor]:
    """Return the weights of a predictor by their plain names, without those of an adapter."""
    return {
        name.replace(".base_layer.", ".").replace(".original_module.", "."): value
        for name, value in predictor.state_dict().items()
        if ".lora_" not in name and ".modules_to_save." not in name
    }


def find_heads_to_replace(sizes: ModelSizes, widths: Widths) -> tuple[str, ...]:
    """Return the names of the input layers that do not fit states and actions of these widths.

    A model without states fits states of any width.
    """
    predictor = sizes.predictor
    fits = {
        "action_encoder": predictor.action_dim == widths.action,
        "state_encoder": not predictor.use_states or predictor.state_dim == widths.state,
    }
    return tuple(name for name, is_suitable in fits.items() if not is_suitable)


def require_trained_heads(heads: tuple[str, ...], config: AdapterConfig) -> None:
    """Check that new input layers are trained.

    Raises:
        InputError: An adapter is trained, and a new layer is not in its modules_to_save; the message shows the setting.
    """
    missing = [name for name in heads if name not in config.modules_to_save]
    if config.kind == "none" or not missing:
        return
    layers = ", ".join([*config.modules_to_save, *missing])
    problem = f"the new {_join_names(missing)} would not be trained; the data have other widths than the base model"
    raise InputError(where="adapter.modules_to_save", found=problem, fix=f"Set adapter.modules_to_save=[{layers}]")


def fit_heads(model: WorldModel, widths: Widths, seed: int) -> list[str]:
    """Replace the input layers that do not fit states and actions of these widths by new layers.

    The new layers are initialised as in the released recipe, with a seed derived from `seed` and the name of the layer.
    The fingerprint of the base model (`WorldModel.predictor_fingerprint`) does not change, but the model predicts noise
    until the new layers are trained.

    Returns:
        A line for each replaced layer.

    Raises:
        ValueError: The model has an adapter or new input layers already.
    """
    heads = find_heads_to_replace(model.sizes, widths)
    if not heads:
        return []
    if model.adaptation is not None or model.new_input_heads is not None:
        raise ValueError("input heads can be replaced only once, before the model is adapted")
    predictor = model.base_predictor
    replaced: dict[str, Tensor] = {}
    lines: list[str] = []
    for name in heads:
        old_head, width = getattr(predictor, name), widths.action if name == "action_encoder" else widths.state
        replaced |= {f"{name}.{key}": value.detach().cpu() for key, value in old_head.state_dict().items()}
        head = nn.Linear(width, old_head.out_features)
        initialise(head, torch.Generator().manual_seed(derive_seed(seed, name)))
        setattr(predictor, name, head.to(old_head.weight.device, old_head.weight.dtype).requires_grad_(False))
        label, old_width = _join_names([name]), old_head.in_features
        lines.append(f"New {label} for {width} numbers, newly initialised; the base model's has {old_width}.")
    dims = {"action_dim": widths.action}
    dims |= {"state_dim": widths.state} if model.sizes.predictor.use_states else {}
    predictor.config.update(dims)
    model.sizes = model.sizes.model_copy(update={"predictor": model.sizes.predictor.model_copy(update=dims)})
    model.new_input_heads = NewInputHeads(replaced, seed)
    return lines


def get_model_widths(sizes: ModelSizes) -> Widths:
    """Return the widths of a model's states and actions.

    For a model without states the width of a state equals the width of an action, because a plan adds actions to
    states.
    """
    predictor = sizes.predictor
    return Widths(
        state=predictor.state_dim if predictor.use_states else predictor.action_dim, action=predictor.action_dim
    )


def describe_model_widths(sizes: ModelSizes) -> str:
    """Describe the states and actions that a model accepts, for messages."""
    predictor = sizes.predictor
    states = f"states of {predictor.state_dim}" if predictor.use_states else "any states"
    return f"{states} and actions of {predictor.action_dim} numbers"


def derive_seed(*parts: object) -> int:
    """Return a seed derived from these values, for example from the seed of the config and a step."""
    digest = hashlib.blake2b("/".join(map(str, parts)).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") >> 1


def _join_names(names: list[str]) -> str:
    return " and the ".join(name.replace("_", " ") for name in names)
