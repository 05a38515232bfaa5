"""Installation of third-party packages for a single test, and simulated packages of a user."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest


def install(python: str | Path, *words: str) -> None:
    """Install packages for a Python interpreter; skip the test if they cannot be installed."""
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--disable-pip-version-check"]
    try:
        process = subprocess.run([*pip, *words], capture_output=True, text=True, timeout=180)
    except subprocess.TimeoutExpired:
        pytest.skip(f"{words} could not be installed within 3 minutes")
    if process.returncode:
        pytest.skip(f"{words} cannot be installed here: {process.stderr.strip().splitlines()[-1:]}")


def leave_package(folder: Path, package: str, entry_points: str, code: str = "thing = print\n") -> None:
    """Write the files of an installed package into a folder: its metadata, entry points and module."""
    about = folder / f"{package}-1.0.dist-info"
    about.mkdir(parents=True, exist_ok=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(entry_points)
    (folder / f"{package}.py").write_text(code)
    importlib.invalidate_caches()
