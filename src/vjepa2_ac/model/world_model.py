"""The world model, an encoder and a predictor: encode, predict, roll out, save and load.

`fit_heads` adds input heads for robots whose states or actions differ from the base's; these heads must be trained.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
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
from vjepa2_ac.model.model_files import CONFIG, FORMAT, HEADS, EncoderOrigin, read_encoder_origin, read_sizes
from vjepa2_ac.model.predictor import LatentDynamics, new_predictor, normalise_latents
from vjepa2_ac.storage import folder_writer
from vjepa2_ac.storage.tensors import read_tensors, save_tensors

ENCODER, PREDICTOR = "encoder.safetensors", "predictor/model.safetensors"


@dataclass(frozen=True)
class Adaptation:
    """The adaptation of the predictor by `model.lora`."""

    kind: Literal["lora", "none"]  # as in config.AdapterConfig; none: every weight is trained
    base: str  # fingerprint of the predictor it started from
    encoder: str  # fingerprint of the encoder whose latents it learns from
    start: dict[str, Tensor] | None = None  # kind none: the weights it started from


class Fingerprints(NamedTuple):
    """Hashes of a model's weights."""

    encoder: str
    base: str  # of the predictor before it was adapted
    predictor: str  # with the trained weights


@dataclass(frozen=True)
class FreshHeads:
    """New input heads of the predictor (`fit_heads`), for states or actions whose widths differ from the base's."""

    replaced: dict[str, Tensor]  # the base's own, by their names in the predictor
    seed: int  # of the new ones


class AbsentEncoder(nn.Module):
    """Placeholder of a removed encoder."""

    def __init__(self, fingerprint: str) -> None:
        super().__init__()
        self.fingerprint = fingerprint  # of the removed one


class WorldModel(LatentDynamics):
    """A frozen encoder and an action-conditioned predictor.

    Latents and predictions are layer-normalised over `dim` without affine, and float32 whatever the weights' type:
    inputs are cast inside. `model.lora.add_adapter` selects the trained weights; before that there are none.

    Create one with `random`, `from_pretrained` or `model.checkpoints.load_official`.
    """

    def __init__(self, sizes: ModelSizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.encoder: Encoder | AbsentEncoder = Encoder(sizes)
        self.predictor: nn.Module = new_predictor(sizes)
        self.predictor.requires_grad_(False)
        self.adaptation: Adaptation | None = None
        self.fresh_heads: FreshHeads | None = None
        self.merged_from: Fingerprints | None = None  # before an adapter was merged
        self.encoder_origin: EncoderOrigin | None = None  # of an encoder that was read by itself

    @classmethod
    def random(
        cls,
        sizes: ModelSizes,
        seed: int,
        dtype: torch.dtype = torch.float32,
        *,
        at_persistence: bool = False,
        device: torch.device | str = "cpu",
    ) -> WorldModel:
        """Return a freshly initialised model: the same weights for the same sizes, seed and kind of device.

        Weights are drawn as in the released recipe; with `at_persistence` the predictor starts close to copying. They
        are drawn on their device: the full size takes half a minute of one CPU core, and no time on a GPU.
        """
        model = cls.empty(sizes).to_empty(device=device)
        generator = torch.Generator(device).manual_seed(seed)
        model.present_encoder.initialise(generator)
        model.draw_predictor(generator, dtype, at_persistence=at_persistence)
        return model.to(dtype)

    def draw_predictor(self, generator: torch.Generator, dtype: torch.dtype, *, at_persistence: bool = False) -> None:
        """Initialise the predictor on the generator's device; it may be without weights."""
        predictor = self.base_predictor.to_empty(device=generator.device)
        predictor.initialise(generator)
        if at_persistence:
            predictor.start_at_persistence(generator)
        predictor.to(dtype)

    @classmethod
    def empty(cls, sizes: ModelSizes) -> WorldModel:
        """Return a model without weights (on the meta device), for loaders to fill; in eval mode."""
        with torch.device("meta"):
            return cls(sizes).eval()

    @classmethod
    def from_pretrained(cls, folder: str | Path, dtype: torch.dtype | None = None) -> WorldModel:
        """Read a folder written by `save_pretrained`; `dtype` None keeps the type of each file.

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
        """Write config.json, encoder.safetensors and predictor/ (which transformers can load by itself).

        The folder is written elsewhere, then moved, config.json last: a folder that has one is complete.

        Raises:
            InputError: The folder cannot be written.
            ValueError: There is an adapter: merge it first, or save it with `adapter_folder.save_trained`. Or the
                encoder was removed.
        """
        if self.predictor is not self.base_predictor:
            raise ValueError("an adapter is on: merge_adapter makes it part of the model, save_trained saves it alone")
        card: dict[str, Any] = {"format": FORMAT, "sizes": self.sizes.model_dump(mode="json")}
        if self.encoder_origin is not None:
            card["encoder_origin"] = asdict(self.encoder_origin)
        encoder = self.present_encoder
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
        """Height and width of a frame in pixels."""
        return self.sizes.image_size

    @property
    def num_tokens(self) -> int:
        """Tokens of one frame."""
        return self.sizes.tokens_per_frame

    @property
    def latent_dim(self) -> int:
        """Width of a latent."""
        return self.sizes.encoder.width

    @property
    def present_encoder(self) -> Encoder:
        """The encoder.

        Raises:
            ValueError: It was removed.
        """
        if isinstance(self.encoder, Encoder):
            return self.encoder
        raise ValueError("the encoder was set aside: latents come from a cache")

    def set_encoder_aside(self) -> None:
        """Remove the encoder's weights permanently: latents come from a cache. The fingerprint is kept."""
        if isinstance(self.encoder, Encoder):
            self.encoder = AbsentEncoder(self.encoder_fingerprint())

    @torch.no_grad()
    def encode(
        self, frames: Float[Tensor, "batch time 3 height width"], chunk: int = ENCODE_CHUNK
    ) -> Float[Tensor, "batch time tokens dim"]:
        """Return the latents of normalised frames, each frame encoded independently.

        Args:
            frames: Frames normalised as in training (ImageNet mean and std).
            chunk: Frames that go through the encoder at once: bounds the memory.

        Raises:
            ValueError: The frames have another size than `image_size`; or the encoder was removed.
        """
        features = normalise_latents(self.present_encoder(frames.flatten(0, 1), chunk))
        return rearrange(features, "(batch time) tokens dim -> batch time tokens dim", batch=len(frames))

    def encoder_fingerprint(self) -> str:
        """Return a hash of the encoder's tensors and of what they do not show: part of the key of cached latents."""
        if isinstance(self.encoder, AbsentEncoder):
            return self.encoder.fingerprint
        tensors, beyond = fingerprint(self.encoder.state_dict()), self.encoder_beyond_tensors
        if not beyond:  # the same for all files with these tensors
            return tensors
        return hashlib.sha256(json.dumps([tensors, beyond], sort_keys=True).encode()).hexdigest()

    @property
    def encoder_beyond_tensors(self) -> dict[str, str | int]:
        """The properties that latents depend on and tensors do not show.

        There are none for V-JEPA 2's tubelets with the published heads, or where a model was made with its encoder.
        """
        sizes, origin, beyond = self.sizes.encoder, self.encoder_origin, dict[str, str | int]()
        if sizes.family != "v2":
            beyond |= {"encoder.family": sizes.family, "encoder.frame": sizes.frame}
        if origin is not None and origin.heads_are_told and HEADS.get(sizes.width) != sizes.heads:
            beyond["encoder.heads"] = sizes.heads
        return beyond

    @property
    def encoder_in_words(self) -> str:
        """The encoder and where it came from, for cards."""
        sizes, frame = self.sizes.encoder, ""
        if sizes.family != "v2":
            frame = f", each frame as {'a tubelet' if sizes.frame == 'tubelet' else 'an image'}"
        origin = f"; from {self.encoder_origin}" if self.encoder_origin else ""
        return f"V-JEPA {sizes.family[1:]}, {sizes.depth} blocks of {sizes.width}, {sizes.heads} heads{frame}{origin}"

    def fingerprints(self) -> Fingerprints:
        """Hash the model, with its adapter separate from its base; for one that was merged, what it was before."""
        if self.merged_from is not None:
            return self.merged_from
        adapted, whole = self.adaptation, fingerprint(self.predictor.state_dict())
        if adapted is not None:
            return Fingerprints(adapted.encoder, adapted.base, whole)
        return Fingerprints(self.encoder_fingerprint(), self.predictor_fingerprint(), whole)

    def predictor_fingerprint(self) -> str:
        """Return a hash of the predictor's own weights; independent of an adapter and of fresh heads."""
        replaced = {} if self.fresh_heads is None else self.fresh_heads.replaced
        return fingerprint(base_weights(self.base_predictor) | replaced)


def fingerprint(weights: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of names, shapes and values rounded to bfloat16.

    Rounding makes it independent of the type in which a checkpoint was loaded, float32 or bfloat16.
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


def heads_to_replace(sizes: ModelSizes, widths: Widths) -> tuple[str, ...]:
    """Return the input heads of a model of these sizes that do not fit states and actions of these widths.

    States of any width fit a model without states.
    """
    own = sizes.predictor
    fits = {
        "action_encoder": own.action_dim == widths.action,
        "state_encoder": not own.use_states or own.state_dim == widths.state,
    }
    return tuple(name for name, does in fits.items() if not does)


def require_trained(heads: tuple[str, ...], config: AdapterConfig) -> None:
    """Refuse to leave a fresh head untrained.

    Raises:
        InputError: An adapter is trained and a head is not among its modules_to_save; says what to set.
    """
    missing = [name for name in heads if name not in config.modules_to_save]
    if config.kind == "none" or not missing:
        return
    whole = ", ".join([*config.modules_to_save, *missing])
    found = f"nothing that trains the {_as_text(missing)}, fresh because the data has other widths than the base"
    raise InputError(where="adapter.modules_to_save", found=found, fix=f"Set adapter.modules_to_save=[{whole}]")


def fit_heads(model: WorldModel, widths: Widths, seed: int) -> list[str]:
    """Replace the input heads that do not fit states and actions of these widths by fresh ones.

    They are initialised as in the released recipe, each from the seed and its own name. The base's identity does not
    change (`WorldModel.predictor_fingerprint`), but without training the model predicts noise.

    Returns:
        A line for each replaced head; none if all fit.

    Raises:
        ValueError: The model is adapted, or has fresh heads already.
    """
    heads = heads_to_replace(model.sizes, widths)
    if not heads:
        return []
    if model.adaptation is not None or model.fresh_heads is not None:
        raise ValueError("heads are replaced once, and before the model is adapted")
    predictor = model.base_predictor
    replaced: dict[str, Tensor] = {}
    lines: list[str] = []
    for name in heads:
        own, width = getattr(predictor, name), widths.action if name == "action_encoder" else widths.state
        replaced |= {f"{name}.{key}": value.detach().cpu() for key, value in own.state_dict().items()}
        head = nn.Linear(width, own.out_features)
        initialise(head, torch.Generator().manual_seed(seed_of(seed, name)))
        setattr(predictor, name, head.to(own.weight.device, own.weight.dtype).requires_grad_(False))
        lines.append(f"{_as_text([name])}: {width} numbers instead of the base's {own.in_features}: newly initialised")
    dims = {"action_dim": widths.action}
    dims |= {"state_dim": widths.state} if model.sizes.predictor.use_states else {}
    predictor.config.update(dims)
    model.sizes = model.sizes.model_copy(update={"predictor": model.sizes.predictor.model_copy(update=dims)})
    model.fresh_heads = FreshHeads(replaced, seed)
    return lines


def widths_of_model(sizes: ModelSizes) -> Widths:
    """Return the widths of a model's states and actions; without states, that of its actions for both.

    A plan changes states by actions: where the model does not tell the width of a state, it is that of an action.
    """
    own = sizes.predictor
    return Widths(state=own.state_dim if own.use_states else own.action_dim, action=own.action_dim)


def widths_as_text(sizes: ModelSizes) -> str:
    """Return which states and actions a model takes, for messages."""
    own = sizes.predictor
    states = f"states of {own.state_dim}" if own.use_states else "any states"
    return f"{states} and actions of {own.action_dim} numbers"


def seed_of(*parts: object) -> int:
    """Return a seed that these values determine, such as a seed of the user and a step."""
    digest = hashlib.blake2b("/".join(map(str, parts)).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") >> 1


def _as_text(names: list[str]) -> str:
    return " and the ".join(name.replace("_", " ") for name in names)
