"""`python -m tests.frontends MOONRAKER ARCHIVES [PICTURES]`: Mainsail and Fluidd drive `canductor run`.

The boards are virtual; Moonraker and the builds of the front ends are unmodified.
Ends with status 0 and a line that says so where ARCHIVES or Chromium is missing.
"""

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import Error, sync_playwright

from tests.frontends import moonraker
from tests.frontends.browser import BUILDS, JOB_NAME, Screen, drive, served, unpack
from tests.frontends.hardware import hardware
from tests.frontends.moonraker import Failed, Moonraker, running, until


def main() -> int:
    """Run all; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("moonraker", help="the program")
    parser.add_argument("archives", type=Path, help="the folder of the builds")
    parser.add_argument("pictures", type=Path, nargs="?", help="where to write a picture of each")
    given = parser.parse_args()
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    missing = [name for name in BUILDS.values() if not (given.archives / name).is_file()]
    if chromium is None or missing:
        why = "Chromium" if chromium is None else ", ".join(missing)
        sys.stdout.write(f"skipped: Mainsail and Fluidd in a browser; not there: {why}\n")
        return 0
    with tempfile.TemporaryDirectory(prefix="canductor-frontends-") as name:
        return _run(given.moonraker, chromium, given.archives, Path(name), given.pictures)


def _run(program: str, chromium: str, archives: Path, folder: Path, pictures: Path | None) -> int:
    data = folder / "data"
    for part in ("config", "gcodes", "comms", "logs"):
        (data / part).mkdir(parents=True)
    config, socket, port = (
        data / "config" / "printer.cfg",
        data / "comms" / "klippy.sock",
        moonraker.free_port(),
    )
    (data / "config" / "moonraker.conf").write_text(moonraker.MOONRAKER.format(port=port, socket=socket))
    (data / "gcodes" / JOB_NAME).write_text(moonraker.JOB)
    words = ["run", str(config), "--klippy-api", str(socket), "--ipc", str(folder / "ipc")]
    host = [sys.executable, "-m", "coordinator.cli.main", *words]
    with (
        hardware(config, folder, moonraker.SECTIONS.format(gcodes=data / "gcodes")),
        running(host, folder / "canductor.log", {}),
        running([program, "-d", str(data)], folder / "moonraker.log", {}),
        sync_playwright() as driver,
    ):
        api = Moonraker(port)
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        try:
            until(lambda: api.state() == "ready", "ready")
            for name in BUILDS:
                with served(unpack(archives, name, folder), port) as address:
                    for step in drive(Screen(name, browser, address), api, config, pictures):
                        sys.stdout.write(f"ok: {step}\n")
                        sys.stdout.flush()
        except (Failed, Error) as failure:
            sys.stdout.write(f"FAILED: {failure}\n")
            for log in (folder / "canductor.log", folder / "moonraker.log"):
                sys.stdout.write(f"--- {log.name}\n{moonraker.last_lines(log)}\n")
            return 1
        finally:
            browser.close()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
