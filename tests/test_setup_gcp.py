"""`setup_gcp.sh` checks access, creates a bucket once, and prints its commands in a dry run."""

import os
import re
import subprocess
from pathlib import Path

import pytest

from paths import ROOT

SCRIPT = ROOT / "scripts" / "setup_gcp.sh"
BUCKET = ("--bucket", "my-checkpoints", "--project", "my-project-123", "--region", "us-central1")
LIST = "gcloud storage buckets list --project=my-project-123 --filter=name=my-checkpoints --format=value(location)"
CREATE = (
    "gcloud storage buckets create gs://my-checkpoints --project=my-project-123 --location=us-central1 "
    "--uniform-bucket-level-access --public-access-prevention"
)
LOGIN = "gcloud auth application-default login"


class Machine:
    """A machine whose gcloud and curl only record their calls; a created bucket exists afterwards."""

    def __init__(self, folder: Path) -> None:
        self.programs, self.calls_file, self.bucket = folder / "bin", folder / "calls", folder / "bucket"
        self.programs.mkdir()
        for name in ("bash", "cat"):
            (self.programs / name).symlink_to(f"/bin/{name}")

    def install(self, *names: str, create: str = "", status: int = 0) -> None:
        """Install programs; `create` is the error of gcloud if it cannot create a bucket."""
        for name in names:
            program = self.programs / name
            refuse = f'echo "{create}" >&2; exit 1' if create else f'echo us-central1 >"{self.bucket}"'
            program.write_text(
                f'#!/bin/bash\necho "{name} $*" >>"{self.calls_file}"\n'
                f'case "$*" in *"buckets list"*) [[ ! -e "{self.bucket}" ]] || cat "{self.bucket}" ;;\n'
                f'*"buckets create"*) {refuse} ;; esac\nexit {status}\n'
            )
            program.chmod(0o755)

    def run(self, *options: str) -> subprocess.CompletedProcess[str]:
        environment = {"PATH": str(self.programs), "HOME": os.devnull}
        return subprocess.run(
            ["/bin/bash", str(SCRIPT), *options], env=environment, capture_output=True, text=True, check=False
        )

    @property
    def calls(self) -> list[str]:
        return self.calls_file.read_text().splitlines() if self.calls_file.exists() else []


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_dry_run_prints_every_command_and_runs_none_even_without_gcloud(machine: Machine) -> None:
    process = machine.run("--dry-run", "--login", *BUCKET)
    assert process.returncode == 0, process.stderr
    commands = [line[2:].replace("\\", "") for line in process.stdout.splitlines() if line.startswith("+ ")]
    assert [commands[0], *commands[2:]] == [LOGIN, LIST, CREATE]
    assert commands[1].startswith("curl --head")
    assert commands[1].endswith("/gresearch/robotics/droid/1.0.1/dataset_info.json")
    machine.install("gcloud", "curl")
    assert machine.run("--dry-run", "--login", *BUCKET).returncode == 0
    assert machine.calls == []


def test_without_options_only_access_to_droid_is_checked(machine: Machine) -> None:
    assert os.access(SCRIPT, os.X_OK)
    machine.install("curl")
    process = machine.run()
    assert process.returncode == 0
    assert (
        "gcloud is not installed; only --login and --bucket need it. To install it, see https://cloud" in process.stdout
    )
    assert "DROID can be read" in process.stdout
    assert [call.split()[0] for call in machine.calls] == ["curl"]


def test_bucket_is_created_once(machine: Machine) -> None:
    machine.install("curl", "gcloud")
    first, second = machine.run(*BUCKET), machine.run(*BUCKET)
    assert (first.returncode, second.returncode) == (0, 0), first.stderr + second.stderr
    assert "gs://my-checkpoints was created, private, in us-central1." in first.stdout
    assert "gs://my-checkpoints exists already, in us-central1." in second.stdout
    assert [call for call in machine.calls if "buckets" in call] == [LIST, CREATE, LIST]


@pytest.mark.parametrize(
    ("gcloud_error", "words"),
    [
        ("HTTPError 409: The requested bucket name is not available.", "exists in another project.*another name"),
        ("HTTPError 403: billing is disabled", "could not be created:\n(?s:.*)HTTPError 403: billing is disabled"),
    ],
)
def test_failed_bucket_creation_is_explained(machine: Machine, gcloud_error: str, words: str) -> None:
    machine.install("curl", "gcloud", create=gcloud_error)
    process = machine.run(*BUCKET)
    assert process.returncode == 1
    assert re.search(words, process.stderr)
    assert not machine.bucket.exists()


def test_failed_step_is_named(machine: Machine) -> None:
    machine.install("curl", status=22)
    process = machine.run()
    assert (process.returncode, "DROID cannot be read from this machine" in process.stderr) == (1, True)
    machine.install("curl")
    not_installed = "gcloud is not installed, and --login"
    for status, options, words in (
        (0, ["--login"], not_installed), (0, BUCKET, not_installed), (1, ["--login"], "the login did not succeed"),
        (1, BUCKET, "cannot be listed"),
    ):  # fmt: skip
        if status:
            machine.install("gcloud", status=status)
        process = machine.run(*options)
        assert (process.returncode, words in process.stderr) == (1, True)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--buckets", "a"], "unknown option: --buckets"),
        (["--bucket"], "--bucket needs a value"),
        (["--bucket", "my-checkpoints"], "belong together"),
        (["--bucket", "gs://my", *BUCKET[2:]], "without gs://"),
        (["--bucket", "My_Bucket", *BUCKET[2:]], "lower-case letters"),
        ([*BUCKET[:2], "--project", "My Project", *BUCKET[4:]], "the project's identifier"),
        ([*BUCKET[:4], "--region", "us central; rm"], "such as us-central1"),
    ],
)
def test_wrong_options_are_named_and_no_command_runs(machine: Machine, options: list[str], words: str) -> None:
    machine.install("curl", "gcloud")
    process = machine.run(*options)
    assert process.returncode == 2
    assert words in process.stderr
    assert "--help" in process.stderr
    assert machine.calls == []
