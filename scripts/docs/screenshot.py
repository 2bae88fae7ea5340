"""Draws a page with WebGL as Chromium shows it:
python scripts/docs/screenshot.py URL OUT.png 900 600

The numbers are the window's width and height in pixels. Chromium's own option `--screenshot` does
not wait for WebGL.
"""

import base64
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

#: Seconds until a page is drawn, on a CPU as well.
WAIT = 20
OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--hide-scrollbars",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-pipe",
)


def screenshot(url: str, width: int, height: int) -> bytes:
    """The PNG of a page in a window of so many pixels."""
    (read_end, to_browser), (from_browser, write_end) = os.pipe(), os.pipe()
    # by this option Chromium reads commands from file 3 and answers to file 4
    shell = ("bash", "-c", f'exec chromium "$@" 3<&{read_end} 4>&{write_end}', "bash")
    with tempfile.TemporaryDirectory() as profile:
        browser = subprocess.Popen(
            [*shell, *OPTIONS, f"--user-data-dir={profile}"],
            pass_fds=(read_end, write_end),
            stderr=subprocess.DEVNULL,
        )
        os.close(write_end)
        with open(to_browser, "wb", buffering=0) as out, open(from_browser, "rb") as back:

            def ask(method: str, session: str | None = None, **parameters: Any) -> dict[str, Any]:
                """The answer to a command of the DevTools protocol."""
                message = {"id": 1, "method": method, "params": parameters}
                message |= {} if session is None else {"sessionId": session}
                out.write(json.dumps(message).encode() + b"\0")
                while True:
                    answer = json.loads(b"".join(iter(lambda: back.read(1), b"\0")))
                    if "id" in answer:  # else an event
                        return answer["result"]

            page = ask("Target.createTarget", url="about:blank")["targetId"]
            session = ask("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
            window = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
            ask("Emulation.setDeviceMetricsOverride", session, **window)
            ask("Page.navigate", session, url=url)
            time.sleep(WAIT)
            picture = ask("Page.captureScreenshot", session)["data"]
            ask("Browser.close")
        browser.wait()
    return base64.b64decode(picture)


if __name__ == "__main__":
    Path(sys.argv[2]).write_bytes(screenshot(sys.argv[1], int(sys.argv[3]), int(sys.argv[4])))
