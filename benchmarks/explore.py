"""How fast is explore's page? From a key to the shown images, in a real browser; and a film of it for the docs.

    python benchmarks/explore.py [RUN_OR_MODEL ...] [--film docs/explore.gif]

needs Chromium and the extra dev. All other words go to explore (a run, --decoder ...).
"""

from __future__ import annotations

import argparse
import io
import platform
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import Page, sync_playwright

KEYS = "adwsrfqeoc"
FILM_KEYS = ("a", "a", "w", "c", "q", "0", "p")
FRAME_MS = 700
SIZE = {"width": 1400, "height": 860}

# Resolves with the milliseconds from a key until the picture of the subject is another one, and drawn.
PRESSED = """key => new Promise(resolve => {
  const pictures = document.querySelector("[data-role=pictures]");
  const began = performance.now();
  new MutationObserver((_, observer) => {
    observer.disconnect();
    requestAnimationFrame(() => resolve(performance.now() - began));
  }).observe(pictures, {childList: true, subtree: true});
  document.body.dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true}));
})"""


def main(arguments: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--film", type=Path, help="write a GIF of the page, too")
    parser.add_argument("--rounds", type=int, default=6, help="of ten keys each (6)")
    options, words = parser.parse_known_args(arguments)
    command = [sys.executable, "-u", "-m", "vjepa2_ac.cli", "explore", *words, "--no-open", "--port", "0"]
    with (
        subprocess.Popen(  # noqa: S603 - our own command
            command, stdout=subprocess.PIPE, text=True
        ) as server,
        sync_playwright() as playwright,
    ):
        try:
            assert server.stdout is not None
            url = next(line.split()[2] for line in server.stdout if line.startswith("The page: "))
            path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
            browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
            page = browser.new_page(viewport=SIZE)  # type: ignore[arg-type]
            measure(page, url, options.rounds)
            if options.film:
                film(page, options.film)
            browser.close()
        finally:
            server.terminate()


def measure(page: Page, url: str, rounds: int) -> None:
    """Print how long the page takes to load, and each step of imagination."""
    page.goto(url)
    idle(page)
    loaded = page.evaluate("performance.now()")
    times: list[float] = []
    for _ in range(rounds):
        for key in KEYS:
            times.append(page.evaluate(PRESSED, key))
            idle(page)
        page.keyboard.press("0")
        idle(page)
    print(f"{platform.processor() or platform.machine()}, {page.locator('[data-role=subject]').inner_text()}")
    print(f"page with its first images: {loaded:.0f} ms")
    print(f"key to images, {len(times)} steps: median {np.median(times):.0f} ms, p95 {np.percentile(times, 95):.0f} ms")


def idle(page: Page) -> None:
    """Wait until the page computes nothing."""
    page.wait_for_function(
        "() => document.querySelector('[data-role=main]').getAttribute('aria-busy') === 'false'"
        " && document.querySelector('[data-role=trail] [aria-current=step]')"
    )


def film(page: Page, path: Path) -> None:
    """Write what a person sees who takes some actions, and lets the model plan."""
    frames = [shot(page)]
    for key in FILM_KEYS:
        page.keyboard.press(key)
        page.wait_for_timeout(FRAME_MS // 2)
        idle(page)
        frames.append(shot(page))
    for _ in range(3):  # of the plan
        page.wait_for_timeout(FRAME_MS)
        frames.append(shot(page))
    frames = [frame.quantize(256, Image.Quantize.MEDIANCUT) for frame in frames]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, optimize=True)
    print(f"film: {path}, {path.stat().st_size / 1e6:.1f} MB")


def shot(page: Page) -> Any:
    """Return what the page looks like, smaller."""
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    return picture.resize((picture.width * 2 // 3, picture.height * 2 // 3), Image.Resampling.LANCZOS)


if __name__ == "__main__":
    main()
