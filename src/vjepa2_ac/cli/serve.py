"""The serve command: a planner behind a websocket, for robots that speak openpi's protocol."""

from __future__ import annotations

import argparse
import os
import sys
from typing import TYPE_CHECKING

from vjepa2_ac.cli.options import (
    NEGATIVE_NUMBERS,
    Commands,
    add_checkpoint,
    argument,
    as_local,
    as_model,
    as_path,
    camera_pose,
    command,
    load_planning_session,
    number_between,
    require_overrides,
    require_to_plan,
    say_places_elsewhere,
    whole_number,
)
from vjepa2_ac.errors import InputError

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable

    import numpy as np

    from vjepa2_ac.serving.about import KeptGoals
    from vjepa2_ac.serving.access import Access
    from vjepa2_ac.serving.server import Served

_GB = 10**9


def add_to(commands: Commands) -> None:
    """Add `serve` to a parser."""
    text = (
        "Serve a planner to a robot over a websocket, in the protocol of openpi's clients: pictures, states and goals"
        " in, actions within planning.limits out (docs/serving.md). Runs until SIGTERM or Ctrl-C."
    )
    parser = command(commands, "serve", _serve, text)
    parser._negative_number_matcher = NEGATIVE_NUMBERS
    argument(parser, "subject RUN_OR_MODEL", "folder of a run, or what model.base takes", as_model)
    argument(parser, "overrides key=value", "such as planning.limits.xyz=[0.01,0.01,0.01]", nargs="*")
    text = "goals that a client may name: pictures, and folders that `vjepa2-ac goals` made"
    argument(parser, "--goals FOLDER", text, as_path)
    text = "delta: changes of each model step; pose: waypoints to the target pose, one a control step (delta)"
    argument(parser, "--actions delta|pose", text, choices=["delta", "pose"], default="delta")
    text = "the key of the camera's picture in requests (the usual ones)"
    argument(parser, "--image-key KEY", text)
    text = "what is told on connect; roboarena: its six keys only (full)"
    argument(parser, "--metadata full|roboarena", text, choices=["full", "roboarena"], default="full")
    text = "the camera in the robot base frame: x,y,z,roll,pitch,yaw; where the model uses it"
    argument(parser, "--extrinsics NUMBERS", text)
    text = "of a decision; then the action is zero (60)"
    argument(parser, "--deadline SECONDS", text, number_between(0, 3600, "seconds"), default=60.0)
    argument(parser, "--dry-run", "plan, and answer zeros", action="store_true")
    group = parser.add_argument_group("who may")
    argument(group, "--host ADDRESS", "where it listens (127.0.0.1: this machine only)", default="127.0.0.1")
    argument(group, "--port N", "0: a free one (8000)", whole_number(0, 65535), default=8000)
    text = "a file with the key that clients send; needed where other machines can reach the address"
    argument(group, "--key-file FILE", text, as_path)
    argument(group, "--insecure", "no key, although others can reach the address", action="store_true")
    text = "a name under which a proxy serves it; again for more"
    argument(group, "--allow-host NAME", text, action="append", default=[])
    argument(group, "--certificate FILE", "TLS: the certificate and those it is signed by, PEM", as_path)
    argument(group, "--certificate-key FILE", "its private key, PEM (in the same file)", as_path)
    group = parser.add_argument_group("record")
    argument(group, "--record FOLDER", "every decision with its pictures, in a new folder", as_path)
    text = "where the record ends (2)"
    argument(group, "--record-gb GB", text, number_between(0, 10_000, "gigabytes"), default=2.0)
    group = parser.add_argument_group("of the model")
    add_checkpoint(group)
    text = "for a model: the config whose planning, crop and dtype count"
    argument(group, "--config CONFIG", text, as_local)


def _serve(options: argparse.Namespace) -> int:
    from vjepa2_ac.errors import require_library

    # Wrong words are told before what takes seconds is imported.
    require_overrides(options.overrides)
    for module in ("websockets", "msgpack", "prometheus_client"):
        require_library(module, where="serve", called=module, extra="serve")
    if options.metadata == "roboarena" and options.actions != "pose":
        found, needed = f"--actions {options.actions}", "--actions pose: RoboArena knows no changes of a pose"
        raise InputError(where="--metadata roboarena", found=found, needed=needed)
    extrinsics, access, tls = camera_pose(options.extrinsics), _access(options), _tls(options)
    require_to_plan(options)

    from vjepa2_ac.console.progress import console
    from vjepa2_ac.serving.about import read_kept_goals
    from vjepa2_ac.serving.recording import require_new_record
    from vjepa2_ac.serving.server import ServerOptions, serve

    if options.record is not None:
        require_new_record(options.record)
    goals = None if options.goals is None else read_kept_goals(options.goals)
    say_places_elsewhere(options.subject)

    def tell(line: str) -> None:
        console.print(line)

    ended = serve(lambda: _loaded(options, goals, extrinsics, tell), ServerOptions(access, options.port, tls), tell)
    if not ended:  # a search or a loading that takes longer than anybody waits: nothing of it is to be kept
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    return 0


def _access(options: argparse.Namespace) -> Access:
    from vjepa2_ac.serving.access import Access, read_key

    key = None if options.key_file is None else read_key(options.key_file)
    return Access(options.host, key, options.insecure, tuple(options.allow_host))


def _tls(options: argparse.Namespace) -> ssl.SSLContext | None:
    """Return how connections are encrypted.

    Raises:
        InputError: The certificate or its key cannot be used.
    """
    import ssl

    if options.certificate is None:
        if options.certificate_key is not None:
            found, needed = "no --certificate", "the certificate that the key belongs to"
            raise InputError(where=f"--certificate-key {options.certificate_key}", found=found, needed=needed)
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(options.certificate, options.certificate_key, password=_no_password)
    except (OSError, ValueError) as error:
        needed = "a certificate and its private key without a password, in PEM"
        raise InputError(where=f"--certificate {options.certificate}", found=str(error), needed=needed) from None
    return context


def _no_password() -> str:
    raise ValueError("the private key has a password")


def _loaded(
    options: argparse.Namespace, goals: KeptGoals | None, extrinsics: np.ndarray | None, tell: Callable[[str], None]
) -> Served:
    """Load the model, and make a first decision; runs in the planning thread."""
    from vjepa2_ac.serving.about import in_words, metadata_of, require_steps, roboarena_metadata, warm_up
    from vjepa2_ac.serving.recording import Recorder
    from vjepa2_ac.serving.request import IMAGE_KEYS
    from vjepa2_ac.serving.server import Served
    from vjepa2_ac.serving.session import Session, SessionOptions

    loaded = load_planning_session(options)
    session_options = SessionOptions(
        options.actions,
        control_steps=require_steps(loaded.config),
        image_keys=IMAGE_KEYS if options.image_key is None else (options.image_key,),
        deadline_s=options.deadline,
        dry_run=options.dry_run,
    )
    controller = loaded.controller(extrinsics=extrinsics)
    kept = {name: loaded.goals_of(folder) for name, folder in (goals or {}).items()}
    session = Session(controller, kept, session_options)
    about = metadata_of(loaded, session)
    told = about if options.metadata == "full" else roboarena_metadata(session)
    tell(in_words(about, options.subject))
    tell(f"a first decision took {warm_up(controller):.1f} s")
    if options.record is not None:
        words = {"overrides": options.overrides, "config": options.config}
        session.recorder = Recorder(
            options.record, {**about, **words, **loaded.as_dict()}, int(_GB * options.record_gb)
        )
    return Served(session, told)
