"""Memory of a long training, of many rendered images, and of a viewer with three browsers.

    python scripts/soak.py [train images viewer] [--minutes 60] [--images 10000]
        [--interactions 1000]

Everything is tiny (16² or 32²), so that it is repeated as often as possible in the time. Writes the
resident memory of every two seconds to ``memory.csv`` and prints, for each part, its median in the
last quarter as a share of its median in the second quarter: after warming up it should not grow.
Ends with an error when it grew by more than 2 %, or when a client of the viewer got no image.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

TINY = [
    *("size=tiny", "data=synthetic", "training=smoke", "trainer=cpu"),
    *("training.log_every=20", "training.schedule.epoch=100"),
    *(
        "training.schedule.step_two=100000000",
        "trainer.check_val_every_n_epoch=10",
    ),
    *(
        "data.source.avatar=free_body",
        "data.source.size=32",
        "data.source.frames=8",
    ),
    *(
        "data.source.test_frames=2",
        "data.source.train_cameras=3",
        "data.source.test_cameras=1",
    ),
    *(
        "data.source.rays_per_pixel=1",
        "data.source.workers=1",
        "data.source.secondary=false",
    ),
]
JOINING = threading.Lock()
EVERY, ALLOWED, CLIENTS = 2.0, 0.02, 3  # seconds; growth; browsers


def resident(pid: int) -> float:
    """Megabytes of a process, without pages of files."""
    with open(f"/proc/{pid}/status") as status:
        fields = dict(line.split(":", 1) for line in status)
    return int(fields["RssAnon"].split()[0]) / 1024


class Curve:
    """Memory over time, by part."""

    def __init__(self) -> None:
        self.rows: list[tuple[str, float, float]] = []

    @contextlib.contextmanager
    def of(self, part: str, pid: int) -> Iterator[None]:
        """Measures a process while the body runs."""
        done, began = threading.Event(), time.monotonic()

        def watch() -> None:
            while not done.wait(EVERY):
                with contextlib.suppress(OSError, KeyError):  # it has ended
                    self.rows.append(
                        (part, time.monotonic() - began, resident(pid))
                    )

        thread = threading.Thread(target=watch)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()

    def table(self) -> pd.DataFrame:
        """part, seconds, megabytes."""
        return pd.DataFrame(self.rows, columns=["part", "seconds", "megabytes"])


def gsgan(command: str, *arguments: str) -> subprocess.Popen[bytes]:
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-m", f"gsgan.{command}", *arguments],
        env=environment,
        stdout=subprocess.DEVNULL,
    )


def train(folder: Path, curve: Curve, minutes: float) -> str:
    """Trains for this long, then stops as a cluster would."""
    process = gsgan("train", *TINY, "evaluate=false", f"hydra.run.dir={folder}")
    end = time.monotonic() + 60 * minutes
    with curve.of("training", process.pid):
        while time.monotonic() < end and process.poll() is None:
            time.sleep(1)
    process.send_signal(signal.SIGTERM)
    process.wait()
    logs = pd.read_csv(next(folder.glob("logs/metrics.csv")))
    return f"{int(logs['step'].max()):,} optimiser steps in {minutes:g} minutes"


def images(run: Path, curve: Curve, count: int, out: Path) -> str:
    """Renders images along an orbit."""
    began = time.monotonic()
    process = gsgan(
        "render", f"run={run}", "motion=rest", f"frames={count}", f"out={out}"
    )
    with curve.of("images", process.pid):
        process.wait()
    made = len(list(out.glob("[0-9]*.png")))
    assert made == count, f"{made} of {count} images"
    return f"{made:,} images in {(time.monotonic() - began) / 60:.1f} minutes"


def viewer(run: Path, curve: Curve, count: int) -> str:
    """Three clients move camera, motion and controls, each waiting for its image."""
    from gsgan.utils.config import defaults_of
    from gsgan.view.server import Viewer, ViewOptions

    config = defaults_of("view")
    config.run, config.port, config.device = str(run), 0, "cpu"
    made = Viewer(ViewOptions.from_config(config))
    began, failures = time.monotonic(), list[str]()
    with curve.of("viewer", os.getpid()):
        share = [
            count // CLIENTS + (i < count % CLIENTS) for i in range(CLIENTS)
        ]
        threads = [
            threading.Thread(target=browse, args=(made, n, i, failures))
            for i, n in enumerate(share)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    made.stop()
    assert not failures, failures[0]
    minutes = (time.monotonic() - began) / 60
    return (
        f"{count:,} interactions of {CLIENTS} clients in {minutes:.1f} minutes"
    )


def browse(viewer: Any, count: int, seed: int, failures: list[str]) -> None:
    """One client: viser's messages over a web socket, as its page sends them."""
    try:
        _browse(viewer, count, random.Random(seed))
    except Exception as error:
        failures.append(f"client {seed}: {type(error).__name__}: {error}")


def _browse(viewer: Any, count: int, rng: random.Random) -> None:
    import msgspec
    import viser
    from websockets.sync.client import connect

    address = viewer.address
    with (
        JOINING
    ):  # one after the other: else it is unknown whose session is whose
        known = set(viewer.sessions)
        socket = connect(
            address.replace("http", "ws", 1),
            origin=address.partition("/?")[0],
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
        )
        threading.Thread(
            target=lambda: [None for _ in socket], daemon=True
        ).start()

        def send(kind: str, **fields: Any) -> None:
            socket.send(msgspec.msgpack.encode({"type": kind} | fields))

        def look() -> None:
            x, y = rng.uniform(-1, 1), rng.uniform(-4, -3)
            send(
                "ViewerCameraMessage", wxyz=(0.7071, -0.7071, 0.0, 0.0), position=(x, y, 1.0),
                fov=0.6, near=0.01, far=100.0, image_height=64, image_width=64,
                look_at=(0.0, 0.0, 1.0), up_direction=(0.0, 0.0, 1.0),
            )  # fmt: skip

        look()
        session = viewer.sessions[
            wait(lambda: set(viewer.sessions) - known).pop()
        ]
    with socket:
        controls = (
            session.slider,
            session.layer,
            session.bones,
            session.mesh,
            session.splats,
        )
        for _ in range(count):
            before = session.started
            control = rng.choice([None, *controls])
            if control is None:
                look()
            else:
                if control is session.slider:
                    choices = range(int(control.max) + 1)
                else:
                    choices = getattr(control, "options", (False, True))
                value = rng.choice([x for x in choices if x != control.value])
                send(
                    "GuiUpdateMessage",
                    uuid=control._impl.uuid,
                    updates={"value": value},
                )
            wait(partial(_answered, session, before))


def _answered(session: Any, before: float) -> bool:
    """Whether a full-size image was rendered since."""
    return bool(session.full and session.started > before)


def wait(holds: Callable[[], Any], seconds: float = 300) -> Any:
    """What ``holds`` returns once it is true; an AssertionError after this long."""
    end = time.monotonic() + seconds
    while not (found := holds()):
        assert time.monotonic() < end, "no image"
        time.sleep(0.005)
    return found


def growth(megabytes: pd.Series) -> tuple[float, float]:
    """Median of the second quarter, and the last quarter's as a share of it."""
    quarter = len(megabytes) // 4
    early = float(megabytes[quarter : 2 * quarter].median())
    return early, float(megabytes[3 * quarter :].median()) / early


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "parts", nargs="*", default=["train", "images", "viewer"]
    )
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--images", type=int, default=10_000)
    parser.add_argument("--interactions", type=int, default=1000)
    parser.add_argument(
        "--run", type=Path, help="of the images and the viewer; else it is made"
    )
    parser.add_argument("--out", type=Path, default=Path("outputs/soak"))
    given = parser.parse_args()
    curve, lines = Curve(), dict[str, str]()
    given.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="gsgan-soak-") as folder:
        run = given.run or Path(folder) / "run"
        if "train" in given.parts:
            lines["training"] = train(
                Path(folder) / "long", curve, given.minutes
            )
        if given.run is None:
            short = (
                "training.schedule.step_two=100",
                "evaluate=false",
                f"hydra.run.dir={run}",
            )
            assert gsgan("train", *TINY, *short).wait() == 0
        if "images" in given.parts:
            lines["images"] = images(
                run, curve, given.images, Path(folder) / "images"
            )
        if "viewer" in given.parts:
            lines["viewer"] = viewer(run, curve, given.interactions)
    table = curve.table()
    table.round(1).to_csv(
        given.out / f"memory_{'_'.join(given.parts)}.csv", index=False
    )
    grew = []
    for part, what in lines.items():
        early, share = growth(
            table.loc[table["part"] == part, "megabytes"].reset_index(drop=True)
        )
        print(
            f"{part}: {what}; {early:.0f} MB, at the end {share:.1%} of that",
            flush=True,
        )
        grew += [part] if share > 1 + ALLOWED else []
    if grew:
        sys.exit(f"memory grew by more than {ALLOWED:.0%}: {', '.join(grew)}")


if __name__ == "__main__":
    main()
