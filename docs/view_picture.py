"""Make docs/view.png: the page of `handtouch demo --view` when it shows a number of forces.

Usage: view_picture.py FOLDER FORCES [OPTION of demo ...]
FOLDER is a copy of tests/javascript after `npm ci`; needs Chromium.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

PICTURE = Path(__file__).parent / "view.png"
SIZE_PX = (1400, 920)


def main(folder: str, forces: str, *options: str) -> None:
    """Run the demo, open its page, and write the picture."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        sys.exit("there is no chromium; on Debian: apt-get install chromium")
    command = [sys.executable, "-m", "handtouch", "demo", "--plain", "--view", *options]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as demo:
        assert demo.stderr is not None
        line = next((line for line in demo.stderr if "http" in line), "")
        shown = "(document.body.innerText.match(/[0-9] N$/gm) || []).length"
        steps = [
            {"size": SIZE_PX},
            {"open": next(word for word in line.split() if word.startswith("http"))},
            {"wait": f"{shown} >= {int(forces)}"},
            {"screenshot": str(PICTURE)},
        ]
        subprocess.run(
            ["node", f"{folder}/browser.mjs", browser],
            input="\n".join(map(json.dumps, steps)),
            text=True,
            check=True,
        )
        demo.terminate()


if __name__ == "__main__":
    main(*sys.argv[1:])
