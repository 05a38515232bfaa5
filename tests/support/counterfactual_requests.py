"""What is asked of counterfactuals of the smallest model, with a decoder that has learned nothing."""

from pathlib import Path

from paths import ROOT
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.decoding.decoder_folder import DecoderCard, save_decoder
from vjepa2_ac.decoding.network import Decoder, DecoderShape
from vjepa2_ac.evaluation.request import EvaluationOptions
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.simulation.counterfactual_sides import SidesOptions


def asked_of_tiny(tmp_path: Path, path: Path) -> SidesOptions:
    """Return a request for one start and two steps, of simulated data at a path."""
    settings = [
        f"data.path={path}", "data.frames=3", "data.stride=4", "data.workers=0", "data.test_share=0.3",
        "data.validation_share=0.2", "planning.limits.xyz=[0.05,0.05,0.05]",
    ]  # fmt: skip
    config = load_config(ROOT / "configs/demo.yaml", settings)
    model = load_base(config.model, seed=0)
    shape = DecoderShape("linear", model.latent_dim, 6, 16)
    encoder = model.encoder_fingerprint()
    card = DecoderCard("vjepa2-ac decoder 1", shape, encoder, "released", "fp32", "data", ("camera",), 3, 30, 100)
    weights = Decoder(shape).state_dict()
    save_decoder(tmp_path / "decoder", card, weights, weights)
    return SidesOptions(
        str(tmp_path / "decoder"), starts=1, steps=2, evaluation=EvaluationOptions(data=config, out=tmp_path / "out")
    )
