"""The commands train, encode, decoder and export."""

from __future__ import annotations

import argparse
import contextlib
import shlex
from pathlib import Path

from vjepa2_ac.cli import options as cli
from vjepa2_ac.errors import InputError, counted, shell_command
from vjepa2_ac.process import is_first_process
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.folder import is_run, read_run_config
from vjepa2_ac.storage import require_new_folder


def add_train(commands: cli.Commands) -> None:
    """Add `train` to a parser."""
    parser = cli.add_command(commands, "train", _train, "my_robot.yaml training.steps=1000")
    cli.add_config(parser, such_as="training.learning_rate=3e-4", what="a YAML config, or (--resume) a run's folder")
    cli.add(
        parser, "--resume", "resume the run in the folder CONFIG; key=value changes its config", action="store_true"
    )
    cli.add(parser, "--check", "run all checks, and stop before the first step", action="store_true")
    cli.add(parser, "--allow-config-change", "resume the run although the config has changed", action="store_true")


def add_encode(commands: cli.Commands) -> None:
    """Add `encode` to a parser."""
    parser = cli.add_command(commands, "encode", _encode, "my_robot.yaml")
    cli.add_config(parser, such_as="data.cache_dtype=int8")
    cli.add(
        parser, "--out FOLDER", "output folder, for data.source: latents (the folder of data.cache)", cli.as_path_or_url
    )
    text = "ray: one actor per GPU (or per CPU core) of this machine; ray=ADDRESS: on a Ray cluster"
    cli.add(parser, "--engine ENGINE", text, _as_engine)


def add_decoder_command(commands: cli.Commands) -> None:
    """Add `decoder` to a parser."""
    parser = cli.add_command(commands, "decoder", _decoder, "my_robot.yaml")
    cli.add_config(parser, such_as="decoder.size=medium")
    cli.add(parser, "--check", "run all checks, and write nothing", action="store_true")


def add_export(commands: cli.Commands) -> None:
    """Add `export` to a parser."""
    parser = cli.add_command(commands, "export", _export, "runs/my_robot merged")
    cli.add(parser, "run RUN", "folder of a run", cli.as_path)
    cli.add(parser, "folder FOLDER", "output folder, new or empty; with --to official also a .pt file", cli.as_path)
    cli.add_overrides(parser, "model.base=PATH, if the base model was moved")
    text = "merged: a model for model.base; official: a .pt with Meta's tensor names; hub: PEFT's format with a card"
    cli.add(parser, "--to", text, choices=["merged", "official", "hub"], default="merged")
    cli.add_checkpoint(parser)


def _train(options: argparse.Namespace) -> None:
    """Train a LoRA adapter, or all weights of the predictor.

    On SIGTERM, SIGINT, SIGUSR1 or SIGHUP: finish the current step, save a checkpoint and exit with status 75. Run the
    same command again to resume. A second signal ends the process at once.
    """
    from vjepa2_ac.model.model_files import require_base_of_run

    path = Path(options.config)
    if options.resume and any(override.startswith("run_dir=") for override in options.overrides):
        needed = "the folder of the run, which is its run_dir"
        raise InputError(where="command line", found="--resume with run_dir", needed=needed)
    if is_run(options.config) and not options.resume:
        fix = "To resume the run, add --resume"
        raise InputError(where=options.config, found="the folder of a run", needed="a config file", fix=fix)
    if options.resume:
        cli.report_remote_urls(options.config)
        config = read_run_config(path, options.overrides)
        require_base_of_run(config.model, path, options.words)
    else:
        config = cli.read_config(path, options.overrides, base=True)

    from vjepa2_ac.cli.tables import TrainingConsole
    from vjepa2_ac.training.loop import train

    with TrainingConsole() as reporter:
        folder = train(config, reporter, check_only=options.check, allow_config_change=options.allow_config_change)
    if is_first_process() and not options.check:
        from vjepa2_ac.runs.subject import describe_selection

        cli.show(describe_selection(folder))
        cli.show(f"The run is in {folder}. To evaluate it: {shell_command('evaluate', folder)}")


def _encode(options: argparse.Namespace) -> None:
    """Encode all frames once, and cache the latents for training.

    The frozen encoder encodes all frames that the clips of the config need. If the command is stopped, only the few
    episodes in progress are lost; run the same command again to resume. Several processes (torchrun) share the work.
    """
    config = cli.read_config(options.config, options.overrides, base=True)

    from vjepa2_ac.encoding.encode_dataset import encode_config

    with contextlib.ExitStack() as exit_stack:
        engine = None
        if options.engine is not None:
            from vjepa2_ac.encoding.ray_engine import ray_engine

            engine = exit_stack.enter_context(ray_engine(options.engine))
        reporter = exit_stack.enter_context(cli.make_reporter()) if is_first_process() else SILENT
        encoded = encode_config(config, reporter, out=options.out, engine=engine)
        if config.replay is not None and options.out is None and not config.replay.data.is_cache:
            encode_config(config.for_replay(), reporter, engine=engine)
    if not encoded.is_finished:
        cli.show(f"This process is finished. Other processes still encode frames into {encoded.folder}")
        return
    episodes = f"{encoded.encoded:,} of {counted(encoded.episodes, 'episode')}"
    overrides = shlex.join(["data.source=latents", f"data.path={encoded.folder}"]) if options.out else "data.cache=auto"
    cli.show(
        *(f"left out: {name}: {reason}" for name, reason in encoded.broken.items()),
        f"{episodes}, {encoded.frames:,} frames, {encoded.bytes / 1e9:.3g} GB are in {encoded.folder}",
        f"Train on them with {overrides}",
    )


def _as_engine(text: str) -> str:
    """Parse the value of --engine: return the address in `ray=ADDRESS`, or an empty string for `ray`."""
    name, separator, address = text.partition("=")
    if name != "ray" or bool(separator) != bool(address):
        raise argparse.ArgumentTypeError(f"{text!r} is neither ray nor ray=ADDRESS")
    return address


def _decoder(options: argparse.Namespace) -> None:
    """Train a decoder that converts latents into images.

    The decoder is trained on the latents of true frames. `imagine` and the option --decoder show predicted frames with
    it. The decoder depends on the encoder and the camera of the config, so all runs with this encoder and camera can
    use it. If the command is stopped, run it again to resume from the last checkpoint.
    """
    config = cli.read_config(options.config, options.overrides, base=True)

    from vjepa2_ac.cli.tables import held_out_table
    from vjepa2_ac.decoding.decoder import read_card
    from vjepa2_ac.decoding.training import train_decoder

    with cli.make_reporter() as reporter:
        folder = train_decoder(config, reporter, check_only=options.check)
    if options.check:
        cli.show("All checks passed: data, model, folder and disk. Nothing was written.")
        return
    card = read_card(folder)
    cli.show(held_out_table(card) if card.held_out else "Held-out frames: not measured; they need a test split.")
    cli.show(f"To show predicted frames of a model: {shell_command('imagine', config.run_dir, '--decoder', folder)}")


def _export(options: argparse.Namespace) -> None:
    """Export the model of a run, or its adapter."""
    config = read_run_config(options.run, options.overrides)
    cli.require_subject(str(options.run), config, options.words)
    require_new_folder(options.folder)

    from vjepa2_ac.export import export_run

    written = export_run(options.run, options.folder, options.to, options.checkpoint, options.overrides)
    descriptions = {"merged": "merged model", "official": "official checkpoint", "hub": "adapter with its model card"}
    cli.show(f"The {descriptions[options.to]} of checkpoint {written.checkpoint} is in {written.path}")
    if options.to == "hub":
        cli.show(
            "The model card contains the local paths of the base model and the data. Read it before you upload it."
        )
