"""Screenshots of the pages of `make demo` in headless Chromium: `python -m docs.make.screens PROJECT`.

They show a generated motion as an animated WebP, the page of a generated motion, and the report.
"""

import asyncio
import base64
import io
import json
import shutil
import subprocess
import sys
import tempfile
import urllib.request
from os import chdir
from pathlib import Path
from typing import Any

from PIL import Image
from websockets.asyncio.client import ClientConnection, connect

from hoidata.hands import load_embedded_hands
from models.text2hoi.generation import MotionOptions
from pipelines.generation import GenerationRequest, generate_files
from pipelines.show_pages import write_page_from

IMAGES = Path(__file__).parents[1] / "images"
PORT = 9333
SWITCHES = ("--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--use-angle=swiftshader")
MOTION, CLIP, FRAMES = "samples/embedded/grab/text2hoi/clips", "grab/s10/mug_drink_1~0", 36
READY = "document.documentElement.dataset.players >= {}"
CANVAS = "JSON.stringify(document.querySelector('canvas').getBoundingClientRect())"
SHOW = """(async () => {{ const bar = document.querySelector('input[type=range]'); bar.value = {};
bar.dispatchEvent(new Event('input')); await new Promise((done) => setTimeout(done, 120)); }})()"""

SENTENCE = "Drink from a mug with the right hand."


class Page:
    """One browser tab, driven through the Chrome DevTools Protocol."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket, self.count = socket, 0

    async def call(self, method: str, **values: Any) -> dict[str, Any]:
        self.count += 1
        await self.socket.send(json.dumps({"id": self.count, "method": method, "params": values}))
        while (answer := json.loads(await self.socket.recv())).get("id") != self.count:
            pass
        return answer["result"]

    async def run(self, script: str) -> Any:
        answer = await self.call("Runtime.evaluate", expression=script, awaitPromise=True)
        return answer["result"].get("value")

    async def open(self, path: Path, width: int, height: int, players: int) -> None:
        await self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
        )
        await self.call("Page.navigate", url=path.resolve().as_uri())
        for _ in range(200):
            if await self.run(READY.format(players)):
                return
            await asyncio.sleep(0.3)
        raise TimeoutError(f"{path} shows no motion")

    async def picture(self, **clip: float) -> Image.Image:
        area = {"clip": {**clip, "scale": 1}} if clip else {}
        answer = await self.call("Page.captureScreenshot", format="png", **area)
        return Image.open(io.BytesIO(base64.b64decode(answer["data"]))).convert("RGB")


async def take(project: Path, folder: Path) -> None:
    """Take all screenshots and write them to docs/images."""
    address = next(tab for tab in _tabs() if tab["type"] == "page")["webSocketDebuggerUrl"]
    async with connect(address, max_size=None) as socket:
        page = Page(socket)
        shown = write_page_from(project / MOTION, CLIP, load_embedded_hands(), folder)
        await page.open(shown, 520, 700, 1)
        box = json.loads(await page.run(CANVAS))
        area = {name: box[name] for name in ("x", "y", "width", "height")}
        frames = []
        for number in range(FRAMES):
            await page.run(SHOW.format(number / (FRAMES - 1)))
            frames.append(await page.picture(**area))
        options = {"save_all": True, "append_images": frames[1:], "duration": 100, "loop": 0, "quality": 70}
        frames[0].save(IMAGES / "motion.webp", **options)
        pages = {"report": project / "report/embedded/index.html", "generate": generated(project, folder)}
        for name, path in pages.items():
            await page.open(path, 1200, 1150, 3)
            await asyncio.sleep(3)
            (await page.picture()).save(IMAGES / f"{name}.png", optimize=True)


def generated(project: Path, folder: Path) -> Path:
    """Generate two motions for a sentence in the project, and return the path of their page."""
    chdir(project)
    request = GenerationRequest(SENTENCE, "mug", "embedded", ("grab",), options=MotionOptions(seed=1, samples=2))
    return generate_files(request, folder / "generated").paths[-1]


def _tabs() -> list[dict[str, Any]]:
    with urllib.request.urlopen(f"http://127.0.0.1:{PORT}/json") as answer:
        return json.load(answer)


def main(project: Path) -> None:
    """Start Chromium and take all screenshots."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        sys.exit("no chromium on PATH")
    with tempfile.TemporaryDirectory() as folder:
        command = [chromium, *SWITCHES, f"--remote-debugging-port={PORT}", f"--user-data-dir={folder}/profile"]
        browser = subprocess.Popen([*command, "--hide-scrollbars", "about:blank"], stderr=subprocess.PIPE, text=True)
        try:
            assert browser.stderr is not None
            while "DevTools listening" not in browser.stderr.readline():
                pass
            asyncio.run(take(project, Path(folder)))
        finally:
            browser.terminate()
            browser.wait()


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
