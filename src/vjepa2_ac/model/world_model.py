"""The world model (encoder and predictor): encode, predict, roll out, save and load.

For robots whose states or actions have other widths than those of the base model, `replace_input_projections` creates
new input projections, which must be trained.
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
    """How the predictor was adapted by `model.lora`, and the identity of its base model."""

    kind: Literal["lora", "none"]  # as in config.AdapterConfig; "none" means that all weights are trained
    base: str  # fingerprint of the predictor before training
    encoder: str  # fingerprint of the encoder
    initial_weights: dict[str, Tensor] | None = None  # weights before training; None for kind "lora"


class Fingerprints(NamedTuple):
    """Hashes of a model's weights."""

    encoder: str
    base: str  # the predictor before it was adapted
    predictor: str  # the predictor with the trained weights


@dataclass(frozen=True)
class NewInputProjections:
    """The record of new input projections (`replace_input_projections`)."""

    replaced: dict[str, Tensor]  # weights of the replaced projections, by their names in the predictor
    seed: int  # seed of the new weights


class RemovedEncoder(nn.Module):
    """A placeholder for a removed encoder, which keeps the encoder's fingerprint."""

    def __init__(self, fingerprint: str) -> None:
        super().__init__()
        self.fingerprint = fingerprint


class WorldModel(LatentDynamics):
    """A frozen encoder and an action-conditioned predictor.

    Latents and predictions are layer-normalised over `dim` without affine parameters, and are float32 for weights of
    any data type. All weights are frozen until `model.lora.add_adapter` selects the weights to train.

    Create a model with `random`, `from_pretrained` or `model.checkpoints.load_official`.
    """

    def __init__(self, sizes: ModelSizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.encoder: Encoder | RemovedEncoder = Encoder(sizes)
        self.predictor: nn.Module = new_predictor(sizes)
        self.predictor.requires_grad_(False)
        self.adaptation: Adaptation | None = None
        self.new_input_projections: NewInputProjections | None = None
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
        Weights are drawn on `device`. For the released model's size this takes half a minute on one CPU core.
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
        """Return a model in eval mode on the meta device, which has no values until weights are loaded."""
        with torch.device("meta"):
            return cls(sizes).eval()

    @classmethod
    def from_pretrained(cls, folder: str | Path, dtype: torch.dtype | None = None) -> WorldModel:
        """Load a model from a folder written by `save_pretrained`; with `dtype` None each file keeps its data type.

        Raises:
            InputError: The folder is not a world model, or is incomplete or damaged.
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

        The files are written into a temporary folder and then moved. config.json is moved last, so a folder with a
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
        with folder_writer(Path(folder), CONFIG) as temporary:
            (temporary / PREDICTOR).parent.mkdir()
            save_tensors(encoder.state_dict(), temporary / ENCODER)
            save_tensors(predictor.state_dict(), temporary / PREDICTOR)
            predictor.config.architectures = [type(predictor).__name__]
            predictor.config.save_pretrained(temporary / "predictor")
            (temporary / CONFIG).write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")

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
        """The number of values of each token of a latent."""
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
        """Return a hash of the encoder's tensors and `encoder_properties`, which is part of a latent cache's key."""
        if isinstance(self.encoder, RemovedEncoder):
            return self.encoder.fingerprint
        tensor_hash, properties = fingerprint(self.encoder.state_dict()), self.encoder_properties
        if not properties:
            return tensor_hash
        return hashlib.sha256(json.dumps([tensor_hash, properties], sort_keys=True).encode()).hexdigest()

    @property
    def encoder_properties(self) -> dict[str, str | int]:
        """The properties of the encoder on which latents depend, but which its tensors do not determine.

        The result is empty for an encoder of V-JEPA 2 that has the published number of heads for its width, or that was
        loaded together with the predictor.
        """
        sizes, origin, properties = self.sizes.encoder, self.encoder_origin, dict[str, str | int]()
        if sizes.family != "v2":
            properties |= {"encoder.family": sizes.family, "encoder.frame": sizes.frame}
        if origin is not None and origin.has_heads_in_fingerprint and PUBLISHED_HEADS.get(sizes.width) != sizes.heads:
            properties["encoder.heads"] = sizes.heads
        return properties

    @property
    def encoder_description(self) -> str:
        """A description of the encoder and its origin in words, for the card of an adapter."""
        sizes, frame = self.sizes.encoder, ""
        if sizes.family != "v2":
            frame = f", each frame as {'a tubelet' if sizes.frame == 'tubelet' else 'an image'}"
        origin = f"; from {self.encoder_origin}" if self.encoder_origin else ""
        return f"V-JEPA {sizes.family[1:]}, {sizes.depth} blocks of {sizes.width}, {sizes.heads} heads{frame}{origin}"

    def fingerprints(self) -> Fingerprints:
        """Return the hashes of base and trained weights; for a merged model the hashes before the merge."""
        if self.merged_from is not None:
            return self.merged_from
        adaptation, predictor = self.adaptation, fingerprint(self.predictor.state_dict())
        if adaptation is not None:
            return Fingerprints(adaptation.encoder, adaptation.base, predictor)
        return Fingerprints(self.encoder_fingerprint(), self.predictor_fingerprint(), predictor)

    def predictor_fingerprint(self) -> str:
        """Return a hash of the base model's predictor, independent of an adapter and of new input projections."""
        replaced = {} if self.new_input_projections is None else self.new_input_projections.replaced
        return fingerprint(base_weights(self.base_predictor) | replaced)


def fingerprint(weights: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of the weights' names, shapes, and values rounded to bfloat16.

    Because of the rounding, a checkpoint has the same fingerprint whether it is loaded as float32 or as bfloat16.
    """
    digest = hashlib.sha256()
    for name, value in sorted(weights.items()):
        digest.update(f"{name} {tuple(value.shape)}\n".encode())
        rounded = value.detach().to("cpu", torch.bfloat16).contiguous()
        digest.update(rounded.view(torch.uint8).numpy().data)
    return digest.hexdigest()


def base_weights(predictor: nn.Module) -> dict[str, Tensor]:
    """Return the weights of a predictor without its adapter, by their names before PEFT wrapped the predictor."""
    return {
        name.replace(".base_layer.", ".").replace(".original_module.", "."): value
        for name, value in predictor.state_dict().items()
        if ".lora_" not in name and ".modules_to_save." not in name
    }


def find_projections_to_replace(sizes: ModelSizes, widths: Widths) -> tuple[str, ...]:
    """Return the names of the input projections that do not fit states and actions of these widths.

    A model without states fits states of any width.
    """
    predictor = sizes.predictor
    fits = {
        "action_encoder": predictor.action_dim == widths.action,
        "state_encoder": not predictor.use_states or predictor.state_dim == widths.state,
    }
    return tuple(name for name, is_fitting in fits.items() if not is_fitting)


def require_trained_projections(new: tuple[str, ...], config: AdapterConfig) -> None:
    """Check that new input projections will be trained.

    Raises:
        InputError: The config is for an adapter without a new projection in modules_to_save. The message shows the fix.
    """
    missing = [name for name in new if name not in config.modules_to_save]
    if config.kind == "none" or not missing:
        return
    layers = ", ".join([*config.modules_to_save, *missing])
    problem = f"the new {_join_names(missing)} would not be trained; the data have other widths than the base model"
    raise InputError(where="adapter.modules_to_save", found=problem, fix=f"Set adapter.modules_to_save=[{layers}]")


def replace_input_projections(model: WorldModel, widths: Widths, seed: int) -> list[str]:
    """Replace the input projections that do not fit states and actions of these widths by new projections.

    The new projections are initialised as in the released recipe, with a seed derived from `seed` and the name of the
    layer. The fingerprint of the base model (`WorldModel.predictor_fingerprint`) does not change, but the model
    predicts noise until the new projections are trained.

    Returns:
        A message for each replaced projection.

    Raises:
        ValueError: The model already has an adapter or new input projections.
    """
    names = find_projections_to_replace(model.sizes, widths)
    if not names:
        return []
    if model.adaptation is not None or model.new_input_projections is not None:
        raise ValueError("input projections can be replaced only once, before the model is adapted")
    predictor = model.base_predictor
    replaced: dict[str, Tensor] = {}
    lines: list[str] = []
    for name in names:
        old, width = getattr(predictor, name), widths.action if name == "action_encoder" else widths.state
        replaced |= {f"{name}.{key}": value.detach().cpu() for key, value in old.state_dict().items()}
        new = nn.Linear(width, old.out_features)
        initialise(new, torch.Generator().manual_seed(derive_seed(seed, name)))
        setattr(predictor, name, new.to(old.weight.device, old.weight.dtype).requires_grad_(False))
        label, old_width = _join_names([name]), old.in_features
        lines.append(f"New {label} for {width} numbers, newly initialised; the base model's has {old_width}.")
    dims = {"action_dim": widths.action}
    dims |= {"state_dim": widths.state} if model.sizes.predictor.use_states else {}
    predictor.config.update(dims)
    model.sizes = model.sizes.model_copy(update={"predictor": model.sizes.predictor.model_copy(update=dims)})
    model.new_input_projections = NewInputProjections(replaced, seed)
    return lines


def get_model_widths(sizes: ModelSizes) -> Widths:
    """Return the widths of a model's states and actions.

    For a model without states the width of states is set to the width of actions, because a planner adds actions to
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
    """Return a random seed derived from these values, for example from the seed of the config and a step."""
    digest = hashlib.blake2b("/".join(map(str, parts)).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") >> 1


def _join_names(names: list[str]) -> str:
    return " and the ".join(name.replace("_", " ") for name in names)
