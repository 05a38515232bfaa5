"""The frozen encoder of V-JEPA 2 or 2.1, which computes the features of single frames."""

from __future__ import annotations

from typing import Any

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Generator, Tensor, nn
from torch.nn.functional import layer_norm, linear

from vjepa2_ac.config import ModelSizes
from vjepa2_ac.config.model import FramePath
from vjepa2_ac.errors import quiet_imports
from vjepa2_ac.model.attention import TokenLayout, rotary_tables, rotate
from vjepa2_ac.model.blocks import NORM_EPSILON, initialise, output_std, without_needless_autocast

with quiet_imports():
    from transformers import VJEPA2Config
    from transformers.models.vjepa2.modeling_vjepa2 import VJEPA2Encoder, VJEPA2RopeAttention

ENCODE_CHUNK = 16  # frames per forward pass; limits the memory
TUBELET = 2  # frames per tubelet; the encoder receives each frame twice
_GRID_OF_POSITIONS = 16  # V-JEPA 2.1 scales the positions of any grid to those of 256 px
_LEVELS = 4  # V-JEPA 2.1 normalises the outputs of four blocks; the last of these norms is that of the last block


class Encoder(nn.Module):
    """The frozen network that encodes single frames, always in eval mode.

    The network is the encoder of transformers' `VJEPA2Model`, without the masked predictor, with two changes. Rotary
    tables are computed once and in float32 (transformers computes angles in the data type of the weights), and patches
    are embedded by one matrix product. V-JEPA 2.1 has other rotary positions, and adds a learned vector for the kind of
    input (video or image) to every patch. Weights that do not affect the output (norms of lower levels, the patch
    embedding of the other kind of input) are loaded, too, because an exported checkpoint must contain them.
    """

    def __init__(self, sizes: ModelSizes) -> None:
        super().__init__()
        self.image_size = sizes.image_size
        self.vit = VJEPA2Encoder(_build_config(sizes))
        width, grid = sizes.encoder.width, sizes.image_size // sizes.patch_size
        if sizes.encoder.family == "v2":
            patches, layout = _FramePatches(width, sizes.patch_size), TokenLayout(1, grid)
        else:
            patches = _PatchesByKind(width, sizes.patch_size, sizes.encoder.frame)
            layout = TokenLayout(1, grid, interleaved=True, scaled_to=_GRID_OF_POSITIONS)
            self.vit.level_norms = nn.ModuleList(nn.LayerNorm(width, eps=NORM_EPSILON) for _ in range(_LEVELS - 1))
        self.vit.embeddings.patch_embeddings.proj = patches
        if not hasattr(VJEPA2RopeAttention, "apply_rotary_embeddings"):
            raise RuntimeError(
                "this version of transformers has no VJEPA2RopeAttention.apply_rotary_embeddings; 5.17 to 5.23 are"
                " tested"
            )
        for block in self.vit.layer:
            block.attention = _ExactAttention(self.vit.config, layout)  # the names of the weights do not change
        self.vit.layernorm = _PreciseNorm(width, eps=NORM_EPSILON)
        self.requires_grad_(False)
        self.eval()

    @torch.no_grad()
    def forward(
        self, frames: Float[Tensor, "frames 3 height width"], chunk: int = ENCODE_CHUNK
    ) -> Float[Tensor, "frames tokens dim"]:
        """Return the features of normalised frames in float32; `normalise_latents` turns them into latents.

        Args:
            frames: Frames normalised as in training.
            chunk: Number of frames per forward pass; limits the memory.

        Raises:
            ValueError: The size of the frames is not the model's image size; positions would be wrong.
        """
        if frames.shape[-2:] != (self.image_size, self.image_size):
            raise ValueError(
                f"frames of {frames.shape[-2]} x {frames.shape[-1]} px; this encoder needs {self.image_size} x"
                f" {self.image_size} px (model.sizes.image_size)"
            )
        weight, features = next(self.vit.parameters()), list[Tensor]()
        for frames_of_chunk in torch.split(frames.to(weight.dtype), chunk):
            tubelets = frames_of_chunk[:, None].expand(-1, TUBELET, -1, -1, -1)
            with without_needless_autocast(tubelets, weight):
                features.append(self.vit(tubelets).last_hidden_state)
        return torch.cat(features)

    def train(self, mode: bool = True) -> Encoder:  # noqa: ARG002  # the signature of nn.Module
        """Keep eval mode, whatever the mode of the surrounding model."""
        return super().train(False)

    def reset_last_norm(self) -> None:
        """Reset the last norm after blocks were removed: its trained weights belong to the last block's output."""
        nn.init.ones_(self.vit.layernorm.weight)
        nn.init.zeros_(self.vit.layernorm.bias)

    def initialise(self, generator: Generator) -> None:
        """Initialise every weight; the generator determines the values.

        Source: facebookresearch/vjepa2 @ c2963a4, src/models/vision_transformer.py, _init_weights and _rescale_blocks.
        """
        for module in self.modules():
            initialise(module, generator)
            if isinstance(module, _PatchesByKind):
                nn.init.zeros_(module.video_kind)
                nn.init.zeros_(module.image_kind)
        for index, block in enumerate(self.vit.layer):
            for output in (block.attention.proj, block.mlp.fc2):
                nn.init.trunc_normal_(output.weight, std=output_std(index + 1), generator=generator)


class _FramePatches(nn.Conv3d):
    """The patch embedding of tubelets of two identical frames, as a matrix product with the kernel summed over time.

    The product needs half the arithmetic of the 3D convolution, which is slow in bfloat16 with some versions of cuDNN.
    """

    def __init__(self, width: int, patch_size: int) -> None:
        kernel = (TUBELET, patch_size, patch_size)
        super().__init__(3, width, kernel_size=kernel, stride=kernel)

    def forward(
        self, tubelets: Float[Tensor, "frames 3 time height width"]
    ) -> Float[Tensor, "frames dim 1 rows columns"]:
        """Return the result of the convolution for tubelets of identical frames."""
        return self._embed(tubelets[:, :, 0], self)

    def _embed(
        self, frames: Float[Tensor, "frames 3 height width"], layer: nn.Conv3d
    ) -> Float[Tensor, "frames dim 1 rows columns"]:
        side = self.kernel_size[-1]
        patches = rearrange(frames, "n c (rows p) (columns q) -> n (rows columns) (c p q)", p=side, q=side)
        embedded = linear(patches, layer.weight.sum(dim=2).flatten(1), layer.bias)
        rows = frames.shape[-2] // side
        return rearrange(embedded, "n (time rows columns) dim -> n dim time rows columns", time=1, rows=rows)


class _PatchesByKind(_FramePatches):
    """The patch embeddings of V-JEPA 2.1 for tubelets and for images, each with a learned vector for the kind of input.

    Source: facebookresearch/vjepa2 @ 204698b, app/vjepa_2_1/models/vision_transformer.py.
    """

    def __init__(self, width: int, patch_size: int, frame: FramePath) -> None:
        super().__init__(width, patch_size)
        kernel = (1, patch_size, patch_size)
        self.frame = frame
        self.of_images = nn.Conv3d(3, width, kernel_size=kernel, stride=kernel)
        self.video_kind = nn.Parameter(torch.zeros(1, 1, width))
        self.image_kind = nn.Parameter(torch.zeros(1, 1, width))

    def forward(
        self, tubelets: Float[Tensor, "frames 3 time height width"]
    ) -> Float[Tensor, "frames dim 1 rows columns"]:
        """Return the embedded patches of frames, encoded as tubelets of identical frames or as images."""
        if self.frame == "tubelet":
            return super().forward(tubelets) + self.video_kind.reshape(1, -1, 1, 1, 1)
        return self._embed(tubelets[:, :, 0], self.of_images) + self.image_kind.reshape(1, -1, 1, 1, 1)


class _ExactAttention(VJEPA2RopeAttention):  # type: ignore[misc]  # transformers has no types
    """The attention of transformers with rotary tables that are computed once, in float32."""

    def __init__(self, config: Any, layout: TokenLayout) -> None:
        super().__init__(config, config.hidden_size, config.num_attention_heads)
        self.layout = layout

    def get_position_ids(self, x: Tensor, masks: Any = None) -> None:  # the signature of transformers
        """Skip the computation of positions (ten kernels per layer), because the tables contain them."""

    def apply_rotary_embeddings(self, qk: Tensor, pos_ids: Any) -> Tensor:  # noqa: ARG002  # the tables contain the positions
        """Return queries or keys [batch heads sequence head_dim], rotated by their position."""
        tables = rotary_tables(self.layout, qk.shape[-1], qk.device)
        return rotate(qk.transpose(1, 2), tables).transpose(1, 2)


class _PreciseNorm(nn.LayerNorm):
    """The last norm, computed in float32, because its result is normalised again and rounding would lose precision."""

    def forward(self, tokens: Tensor) -> Tensor:
        return layer_norm(tokens.float(), self.normalized_shape, self.weight.float(), self.bias.float(), self.eps)


def _build_config(sizes: ModelSizes) -> Any:
    config = VJEPA2Config(
        patch_size=sizes.patch_size,
        crop_size=sizes.image_size,
        frames_per_clip=TUBELET,
        tubelet_size=TUBELET,
        hidden_size=sizes.encoder.width,
        num_hidden_layers=sizes.encoder.depth,
        num_attention_heads=sizes.encoder.heads,
        mlp_ratio=sizes.encoder.mlp_ratio,
        layer_norm_eps=NORM_EPSILON,
    )
    config._attn_implementation = "sdpa"
    return config
