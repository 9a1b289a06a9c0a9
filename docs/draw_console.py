"""Pictures of docs/console.md, the README's animation: ``python docs/draw_console.py STORE SWEEP``.

Starts the console on a store, one of whose sweeps is shown, and takes pictures of it in Debian's
Chromium. The animation is taken step by step, so it does not depend on the computer's speed.
"""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

IMAGES = Path(__file__).parent / "images"
WIDE, PHONE = 1400, 390
COLOURS = 128  # of a picture
ANIMATION = 720  # pixels, its width
SHADES = 48  # its colours
EPISODES = 4  # that it shows, of 25 steps each
EVERY = 2  # steps from one picture to the next
DURATION = 110  # milliseconds that each is shown
RAISED = (0.2, 0.75)  # shares of the animation between which the proximity rises
WAIT = 120_000  # milliseconds


def main() -> None:
    """Take all pictures."""
    store, sweep = sys.argv[1:]
    IMAGES.mkdir(exist_ok=True)
    with _console(store) as address, _browser() as browser:
        _take(browser, f"{address}?policy=turbine", WIDE, "console-turbine", 0.3, 140)
        _take(browser, f"{address}?policy=turbine", PHONE, "console-warning", 0.45, 120)
        _take(browser, f"{address}?policy=world", WIDE, "console-world", 0.9, 60)
        _take(browser, f"{address}?policy=world", PHONE, "console-phone", 0.9, 60)
        page = browser.new_page(viewport={"width": WIDE, "height": 900})
        page.goto(f"{address}sweep?name={sweep}")
        page.locator(".cell.done").first.click(timeout=WAIT)
        page.locator(".chart canvas").wait_for(timeout=WAIT)
        _save(page.screenshot(full_page=True, animations="disabled"), "console-sweep")
        _animate(browser.new_page(viewport={"width": 1000, "height": 1100}), address)


@contextmanager
def _console(store: str) -> Iterator[str]:
    """The address of a running console."""
    words = [sys.executable, "-m", "flows.console", f"store={store}"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        yield server.stdout.readline().split()[1]
        server.terminate()


@contextmanager
def _browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        yield browser
        browser.close()


def _turn(page: Page, proximity: float) -> None:
    page.get_by_role("slider").wait_for(timeout=WAIT)
    box = page.locator(".dial .q-slider").bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + proximity * box["width"], box["y"] + box["height"] / 2)


def _drawn(page: Page, steps: int) -> None:
    """Wait until so many steps are drawn."""
    ready = f"Number(document.querySelector('.scene')?.dataset.steps ?? 0) >= {steps}"
    page.wait_for_function(ready, timeout=WAIT)


def _take(
    browser: Browser, address: str, width: int, name: str, proximity: float, steps: int
) -> None:
    """A picture of a session in which the proximity was turned after a third of the steps."""
    page = browser.new_page(viewport={"width": width, "height": 844})
    page.goto(address)
    _drawn(page, steps // 3)
    _turn(page, proximity)
    _drawn(page, steps)
    page.mouse.move(0, 0)
    _save(page.screenshot(full_page=True, animations="disabled"), name)
    page.close()


def _save(screenshot: bytes, name: str) -> None:
    with Image.open(BytesIO(screenshot)) as picture:
        reduced = picture.convert("RGB").quantize(COLOURS)
    reduced.save(IMAGES / f"{name}.png", optimize=True)


def _animate(page: Page, address: str) -> None:
    """The dial and the map, while the proximity rises."""
    page.goto(f"{address}?policy=world")
    _drawn(page, 1)
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Reset").click()
    page.get_by_role("button", name="Pause").click()
    shown = int(page.locator(".scene").get_attribute("data-steps") or 0)
    dial, scene = (page.locator(part).bounding_box() for part in (".dial", ".scene"))
    assert dial is not None
    assert scene is not None
    bottom = scene["y"] + scene["height"] + 12
    shot: Any = {"x": dial["x"], "y": dial["y"] - 6, "width": dial["width"]}
    shot["height"] = bottom - shot["y"]
    step_on = page.get_by_role("button", name="Step").element_handle()
    pictures, steps = [], 25 * EPISODES
    low, high = RAISED
    for step in range(steps):
        share = (step / steps - low) / (high - low)
        if 0 <= share <= 1:
            _turn(page, min(0.999, max(0.001, share)))
        step_on.evaluate("button => button.click()")
        _drawn(page, shown + step + 1)
        if step % EVERY == 0:
            picture = Image.open(BytesIO(page.screenshot(clip=shot))).convert("RGB")
            height = round(picture.height * ANIMATION / picture.width)
            pictures.append(picture.resize((ANIMATION, height)))
    palette = pictures[-1].quantize(SHADES)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    frames[0].save(
        IMAGES / "console.gif",
        save_all=True,
        append_images=frames[1:],
        duration=DURATION,
        loop=0,
        optimize=True,
    )


if __name__ == "__main__":
    main()
