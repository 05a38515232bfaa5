"""LoRA fine-tuning of V-JEPA 2-AC as one flat loop, to be read from top to bottom.

    python examples/train_loop.py [DATA] [STEPS]

DATA is a folder in the RLDS format of DROID. Without DATA the script first records a few episodes of a simulated arm.
The algorithm is that of `vjepa2-ac train`, without config files, several processes, checkpoints and signal handling.
`tests/training/test_train_loop.py` checks that both compute the same weights, bit for bit on a CPU.
"""

import math
import sys
from pathlib import Path
from typing import cast

import torch
from peft import LoraConfig, PeftModel, get_peft_model
from torch import Tensor, nn

from vjepa2_ac import UserError, encode, load_model, open_dataset, read_clips
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import training_loader
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.lora import LoraLinear
from vjepa2_ac.model.predictor import KeyValueCache
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset

RECORDED = Path("demo/examples/data")
BASE, SEED = "builtin:sim-tiny", 0
FRAMES, STRIDE = 4, 4  # a clip has 4 frames, 4 control steps (0.27 s at 15 Hz) apart
RANK, ALPHA, TARGETS = 16, 32, ["q", "k", "v", "o", "fc1", "fc2"]
BATCH, LEARNING_RATE, WARM_UP, WEIGHT_DECAY, MAX_NORM = 6, 3e-3, 5, 0.04, 1.0
ROLLOUT = 2  # number of predictions in the rollout loss


def main(data: str = "", steps: str = "60") -> None:
    """Fine-tune the built-in model, compare it with persistence on held-out episodes, and save the adapter."""
    if not data and not RECORDED.exists():
        print("Recording 12 episodes of the simulated arm ...")
        record_dataset(RECORDED, RecordingSpec("B", steps=33, seed=4), episodes=12)
    model, losses = train(data or str(RECORDED), int(steps))
    print(f"Loss of the first step {losses[0]:.4f}, of the last {losses[-1]:.4f}")
    cast(PeftModel, model.predictor).save_pretrained("demo/examples/adapter")  # in PEFT's format


def train(data: str, steps: int) -> tuple[WorldModel, list[float]]:
    """Return the trained model and the loss of each step."""
    # The data: clips of frames [batch, time, height, width, 3], states [batch, time, 7] and the actions between them.
    dataset = open_dataset(data, frames=FRAMES, stride=STRIDE, validation_share=0.2, test_share=0.3, workers=0)
    clips = training_loader(dataset, seed=SEED, batch_size=BATCH)

    # The model: a frozen encoder, and a predictor of the next frame's latents, of which only the adapter is trained.
    model = load_model(BASE, device="cpu", dtype="float32")
    add_lora(model)
    print("Before training:", validate(model, dataset))

    trained = [weight for weight in model.parameters() if weight.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=LEARNING_RATE, betas=(0.9, 0.999), weight_decay=WEIGHT_DECAY)
    losses = []
    model.train()
    for step in range(1, steps + 1):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate_at(step, steps)
        batch = encode(model, next(clips))  # latents [batch, time, tokens, dim], layer-normalised
        forced_loss, rollout_loss = two_losses(model, batch)
        loss = forced_loss + rollout_loss
        torch.autograd.backward(loss)
        nn.utils.clip_grad_norm_(trained, MAX_NORM)
        optimizer.step()
        optimizer.zero_grad()
        losses.append(forced_loss.item() + rollout_loss.item())
        if step % 10 == 0:
            print(f"step {step}: loss {loss:.4f} (teacher forcing {forced_loss:.4f}, rollout {rollout_loss:.4f})")
    print("After training:", validate(model, dataset))
    return model, losses


def add_lora(model: WorldModel) -> None:
    """Put a LoRA adapter on the linear layers of the predictor's blocks.

    The second matrix of each adapter is zero, so a fresh adapter does not change the predictions. `LoraLinear` is
    PEFT's layer with fewer passes over the tokens. The first matrices are drawn from a separate generator, so that the
    values do not depend on the version of PEFT.
    """
    config = LoraConfig(r=RANK, lora_alpha=ALPHA, target_modules=TARGETS, lora_dropout=0.0, use_rslora=True)
    config._register_custom_module({nn.Linear: LoraLinear})
    model.predictor = get_peft_model(model.predictor.requires_grad_(False), config)
    generator = torch.Generator().manual_seed(SEED)
    for name, weight in model.predictor.named_parameters():
        if ".lora_A." in name:
            nn.init.kaiming_uniform_(weight, a=math.sqrt(5), generator=generator)


def two_losses(model: WorldModel, batch: LatentBatch) -> tuple[Tensor, Tensor]:
    """Return the losses of teacher forcing and of a short rollout: mean absolute differences of latents.

    Teacher forcing predicts each frame from the true frames before it. The rollout starts at the first frame, and makes
    each further prediction from the predictions before it. Both have the same first step, so the rollout reuses the
    keys and values of this step.
    """
    states, cache = batch.states[:, :-1], KeyValueCache()
    forced = model.predict(batch.latents[:, :-1], batch.actions, states, cache=cache, keep=1)
    rolled = forced[:, :1]
    further = model.rollout(rolled, batch.actions[:, 1:ROLLOUT], states[:, 1:ROLLOUT], cache=cache)
    rolled = torch.cat([rolled, further], dim=1)
    true_latents = batch.latents[:, 1:]
    return (forced - true_latents).abs().mean(), (rolled - true_latents[:, :ROLLOUT]).abs().mean()


def learning_rate_at(step: int, steps: int) -> float:
    """Return the learning rate of step 1..steps: a linear warm-up, then half a cosine to 0."""
    if step <= WARM_UP:
        return LEARNING_RATE * step / WARM_UP
    return LEARNING_RATE * 0.5 * (1.0 + math.cos(math.pi * (step - WARM_UP) / max(1, steps - WARM_UP)))


@torch.no_grad()
def validate(model: WorldModel, dataset: Dataset) -> str:
    """Measure the one-step error on held-out episodes, relative to persistence: copying the last frame."""
    model.eval()
    model_error = persistence_error = 0.0
    for clips in read_clips(dataset, "validation", clips=16):
        batch = encode(model, clips)
        predicted = model.predict(batch.latents[:, :-1], batch.actions, batch.states[:, :-1])
        model_error += (predicted - batch.latents[:, 1:]).abs().mean().item()
        persistence_error += (batch.latents[:, :-1] - batch.latents[:, 1:]).abs().mean().item()
    model.train()
    return f"one-step error / persistence {model_error / persistence_error:.3f} (below 1 is better)"


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except UserError as error:
        sys.exit(f"error: {error}")
