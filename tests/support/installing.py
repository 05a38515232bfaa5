"""Packages of others that a test tries, installed for it alone."""

import subprocess
import sys
from pathlib import Path

import pytest


def install(python: str | Path, *words: str) -> None:
    """Install packages for a Python, or skip aloud."""
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--disable-pip-version-check"]
    try:
        done = subprocess.run([*pip, *words], capture_output=True, text=True, timeout=180)
    except subprocess.TimeoutExpired:
        pytest.skip(f"{words} could not be installed within 3 minutes")
    if done.returncode:
        pytest.skip(f"{words} cannot be installed here: {done.stderr.strip().splitlines()[-1:]}")
