"""Kills every command at random moments, runs it again, and compares with an undisturbed run.

    python scripts/chaos.py [--kills 240] [--disk] [--only train,render] [--seed 0]

Each command runs on a scene of 16² in a child of one process that has imported everything. A child
is killed (SIGKILL, SIGTERM, SIGINT) at a random moment, or as it is about to open, rename or make
its N-th file, or that operation fails with "no space left". Then the same command runs again, and
its result must equal an undisturbed run's bit for bit. With ``--disk`` the commands also run on a
full file system (a tmpfs, which needs root), then again with room.

Prints and writes a table, and ends with an error when a kill was not survived.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import errno
import hashlib
import importlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# also because a process with threads cannot be forked
os.environ["OMP_NUM_THREADS"] = "1"
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "data"))
sys.path.insert(
    0, str(Path(__file__).resolve().parents[1] / "tests" / "prepare")
)

import gsgan.utils.compat  # noqa: F401  (before lightning)

# isort: split
import cv2
import torch
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from omegaconf import DictConfig

from gsgan.synthetic.scenes import ensure_scene
from gsgan.utils.errors import GsganError
from gsgan.utils.files import cache_root

torch.set_num_threads(1)
cv2.setNumThreads(0)

LIMIT = 1800  # seconds after which a child counts as hanging
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
SCENE: dict[str, Any] = {
    "avatar": "free_body",
    "size": 16,
    "frames": 4,
    "test_frames": 1,
    "train_cameras": 2,
    "test_cameras": 1,
    "rays_per_pixel": 1,
    "workers": 1,
    "secondary": False,
}
SCHEDULE = {
    "segmentation": 2,
    "step_one": 2,
    "step_two": 4,
    "discriminator_start": 1,
    "epoch": 2,
}
TINY = [
    *(
        "size=tiny",
        "data=synthetic",
        "training=smoke",
        "trainer=cpu",
        "size.image=16",
        "lpips.nets=[]",  # whose images have at least 32 pixels
    ),
    *("grid_rows=1", "trainer.check_val_every_n_epoch=2"),
    *(
        f"data.source.{key}={str(value).lower()}"
        for key, value in SCENE.items()
    ),
    *(f"training.schedule.{key}={value}" for key, value in SCHEDULE.items()),
]
FIT = [
    "data=capture",
    "size.image=48",
    "fit.points=400",
    "fit.surface_steps=6",
    "fit.sweeps=3",
]
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


@dataclass(frozen=True)
class Stage:
    """A command to kill.

    Args:
        command: after ``gsgan.``.
        arguments: of the command, ``{out}`` is its folder, ``{base}`` the finished inputs'.
        inputs: of ``base``, copied into ``out`` because the command writes there.
        again: arguments added where the command runs again.
        share: of all kills.
    """

    command: str
    arguments: list[str]
    inputs: str | None = None
    again: tuple[str, ...] = ()
    share: float = 1.0


STAGES = {
    "data": Stage("data", []),
    "prepare": Stage(
        "prepare",
        [
            *(
                "source={base}/project",
                "landmarks={base}/project/pose",
                "solve.refinements=0",
            ),
            *("masks={base}/project/masks", "workers=1", "out={out}/dataset"),
        ],
    ),
    "fit": Stage("fit", [*FIT, "data.root={out}", "device=cpu"], "people"),
    "train": Stage("train", [*TINY, "hydra.run.dir={out}/run"], share=1.5),
    "evaluate": Stage("evaluate", ["run={out}", "device=cpu"], "run"),
    "render": Stage(
        "render",
        [
            "run={base}/run",
            "motion=novel_pose",
            "pixels=16",
            "frames=8",
            "out={out}/video.mp4",
        ],
    ),
    "images": Stage(
        "render",
        ["run={base}/run", "motion=rest", "frames=8", "out={out}/images"],
        again=("overwrite=true",),
    ),
    "export": Stage(
        "export",
        ["run={base}/run", "frames=4", "out={out}/splats"],
        again=("overwrite=true",),
    ),
    "sweep": Stage(
        "train",
        ["-m", *TINY, "seed=0,1", "hydra.sweep.dir={out}/sweep"],
        share=0.4,
    ),
}


# -- children


def child(work: Callable[[], None], log: Path) -> int:
    """The id of a child that does this work, its output in a file."""
    pid = os.fork()
    if pid:
        return pid
    signal.alarm(LIMIT)
    out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(out, 1)
    os.dup2(out, 2)
    code = 0
    try:
        work()
    except SystemExit as end:
        code = (
            end.code if isinstance(end.code, int) else int(end.code is not None)
        )
    except BaseException:
        traceback.print_exc()
        code = 99
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def command(stage: Stage, place: dict[str, Path], again: bool) -> None:
    """Runs the command in this process; making data is no command of its own."""
    if stage.command == "data":
        try:
            ensure_scene(cache=place["out"], progress=False, **SCENE)
        except GsganError as error:
            sys.exit(f"gsgan: {error}")
        return
    given = [*stage.arguments, *(stage.again if again else ())]
    sys.argv = [f"gsgan.{stage.command}", *(a.format(**place) for a in given)]
    importlib.import_module(f"gsgan.{stage.command}.__main__").main()


def remember_configs() -> None:
    """Makes Hydra compose each config once, which takes most of the time of a tiny run."""
    compose, known = (
        ConfigLoaderImpl.load_configuration,
        dict[str, DictConfig](),
    )

    def load(
        self: ConfigLoaderImpl, *given: object, **named: object
    ) -> DictConfig:
        key = repr((given, named))
        if key not in known:
            known[key] = compose(self, *given, **named)  # type: ignore[arg-type]
        return copy.deepcopy(known[key])

    ConfigLoaderImpl.load_configuration = load  # type: ignore[method-assign, assignment]


def operations(strike: Callable[[int], None], within: Path) -> None:
    """Calls ``strike(n)`` before this process opens for writing, renames or makes its n-th file or
    folder below a folder, from n = 1."""
    count, own = 0, os.getpid()
    events = {"open", "os.rename", "os.mkdir"}

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        nonlocal count
        if event not in events or os.getpid() != own:
            return
        if event == "open" and not int(arguments[2] or 0) & WRITES:  # type: ignore[call-overload]
            return
        if not str(arguments[0]).startswith(str(within)):
            return
        count += 1
        strike(count)

    sys.addaudithook(hook)


# -- results


def result(name: str, place: Path) -> dict[str, str]:
    """Digests of everything that a command is for, by file."""
    found: dict[str, str] = {}
    for path in sorted(place.rglob("*")):
        inside = path.relative_to(place)
        if not path.is_file() or path.suffix in (
            ".part",
            ".lock",
            ".html",
            ".log",
        ):
            continue
        if {"logs", "multirun.yaml", "facts.json", "MODEL_CARD.md"} & {
            *inside.parts
        }:
            continue  # times, versions
        if any(part.startswith((".", "logs_")) for part in inside.parts):
            continue
        content = weights(path) if path.suffix == ".ckpt" else path.read_bytes()
        if path.suffix == ".md":
            # of a tree that changed meanwhile
            content = re.sub(rb"commit \w+", b"", content)
        found[str(inside)] = hashlib.sha256(content).hexdigest()
    assert found, f"{name} left nothing in {place}"
    return found


def weights(path: Path) -> bytes:
    """Weights, optimisers' states and iteration of a checkpoint, as bytes."""
    state = torch.load(path, map_location="cpu", weights_only=True)
    kept = [
        state["state_dict"],
        state["optimizer_states"],
        state["gsgan"]["step"],
    ]
    digest = hashlib.sha256()

    def add(value: object) -> None:
        if isinstance(value, torch.Tensor):
            digest.update(value.contiguous().numpy().tobytes())
        elif isinstance(value, dict):
            for key in value:
                digest.update(str(key).encode())
                add(value[key])
        elif isinstance(value, list | tuple):
            for part in value:
                add(part)
        else:
            digest.update(repr(value).encode())

    add(kept)
    return digest.digest()


# -- trials


@dataclass(frozen=True)
class Truth:
    """An undisturbed run: digests of its files, processor time, number of file operations."""

    result: dict[str, str]
    seconds: float
    operations: int


class Chaos:
    """Stages, their undisturbed results, and what became of every kill."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.random = folder, random.Random(seed)
        self.base = folder / "base"
        self.counts: Counter[tuple[str, str, str]] = Counter()
        self.problems: list[str] = []

    def place(self, name: str, out: Path) -> dict[str, Path]:
        """Makes the empty folder of a trial, with the stage's inputs and cache."""
        shutil.rmtree(out, ignore_errors=True)
        inputs = STAGES[name].inputs
        if inputs is None:
            out.mkdir(parents=True)
        else:
            shutil.copytree(self.base / inputs, out)
        return {"out": out, "base": self.base}

    def whole(
        self, name: str, out: Path, again: bool = False, make: bool = True
    ) -> str:
        """Runs a stage to its end; its output. An AssertionError where it fails."""
        place = (
            self.place(name, out) if make else {"out": out, "base": self.base}
        )
        pid = child(
            lambda: command(STAGES[name], place, again),
            log := self.folder / "log",
        )
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        text = log.read_text(errors="replace")
        finished = again and (
            "exists already" in text or "exists; give" in text
        )
        assert status == 0 or finished, (
            f"{name} ends with {status}: {text[-2000:]}"
        )
        return text

    def prepare(self, name: str) -> Truth:
        """The undisturbed result of a stage; before that it runs in this process, which imports
        what all children need."""
        log, numbers = self.folder / "log", self.folder / "numbers.json"
        place = self.place(name, self.folder / "disk" / "out")
        with (
            log.open("w") as out,
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(out),
        ):
            try:
                command(STAGES[name], place, again=False)
            except SystemExit as end:
                out.flush()
                raise AssertionError(log.read_text()[-2000:]) from end
        place = self.place(name, place["out"])

        def work() -> None:
            seen = [0]
            operations(lambda n: seen.__setitem__(0, n), place["out"])
            command(STAGES[name], place, again=False)
            numbers.write_text(json.dumps([sum(os.times()[:4]), seen[0]]))

        status = os.waitpid(child(work, log), 0)[1]
        assert status == 0, log.read_text()[-2000:]
        shutil.copytree(place["out"], self.folder / "whole" / name)
        return Truth(
            result(name, place["out"]), *json.loads(numbers.read_text())
        )

    def kill(self, name: str, way: str, truth: Truth) -> None:
        """One kill, the same command again, and the comparison."""
        expected = truth.result
        out = self.folder / "disk" / "out"
        place, log = self.place(name, out), self.folder / "log"
        at = self.random.randint(1, truth.operations)
        moment = self.random.uniform(0, truth.seconds)

        def work() -> None:
            def strike(n: int) -> None:
                if n == at and way == "operation":
                    os.kill(os.getpid(), signal.SIGKILL)
                if n >= at and way == "no space":
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

            if way in ("operation", "no space"):
                operations(strike, out)
            command(STAGES[name], place, again=False)

        pid = child(work, log)
        if way in (s.name for s in SIGNALS):
            while not os.waitid(
                os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT
            ):
                if processor_seconds(pid) >= moment:
                    os.kill(pid, signal.Signals[way])
                    break
                time.sleep(0.002)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        text = log.read_text(errors="replace")
        when = (
            f"{moment:.1f} s"
            if way in (s.name for s in SIGNALS)
            else f"operation {at}"
        )
        what = f"{name}, {way} at {when}"
        if way == "no space" and (
            "Traceback" in text or status in (99, -signal.SIGALRM)
        ):
            self.problem(name, way, f"{what}: no sentence but {text[-1500:]}")
            return
        if status == 0:
            if self.equal(name, expected, out):
                self.counts[name, way, "too late"] += 1  # it had finished
            else:
                self.problem(
                    name, way, f"{what}: unfinished, but the exit status is 0"
                )
            return
        try:
            self.whole(name, out, again=True, make=False)
        except AssertionError as error:
            self.problem(name, way, f"{what}: {error}")
            return
        if self.equal(name, expected, out):
            self.counts[name, way, "survived"] += 1
        else:
            now = result(name, out)
            other = sorted(
                k for k in {*now, *expected} if now.get(k) != expected.get(k)
            )
            self.problem(name, way, f"{what}: other {', '.join(other)}")

    def kills(self, name: str) -> int:
        """Of a stage, those that came before its end."""
        return sum(
            n
            for key, n in self.counts.items()
            if key[0] == name and key[2] != "too late"
        )

    def equal(self, name: str, expected: dict[str, str], out: Path) -> bool:
        """Whether the folder holds the undisturbed result, and more files at most hidden ones."""
        with contextlib.suppress(Exception):
            return result(name, out) == expected
        return False

    def problem(self, name: str, way: str, text: str) -> None:
        """Counts a kill that was not survived."""
        self.counts[name, way, "lost"] += 1
        self.problems.append(text)
        print(f"LOST {text}", flush=True)

    def disk(self, name: str, expected: dict[str, str], share: float) -> None:
        """The command on a file system with room for a share of its result, then with room."""
        kept = pages(self.base / (STAGES[name].inputs or "none"))
        made = pages(self.folder / "whole" / name) - kept
        with mounted(
            self.folder / "disk", 4096 * int(2 + kept + share * made)
        ) as room:
            try:
                place = self.place(name, room / "out")
            except OSError:
                return  # its inputs take all the room
            log = self.folder / "log"
            pid = child(lambda: command(STAGES[name], place, again=False), log)
            status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            text, what = (
                log.read_text(errors="replace"),
                f"{name}, a disk of {share:.0%}",
            )
            if status == 0:
                self.counts[name, "full disk", "too late"] += 1
                return
            if "Traceback" in text or status in (99, -signal.SIGALRM):
                self.problem(name, "full disk", f"{what}: {text[-1500:]}")
                return
            run("mount", "-o", "remount,size=200m", str(room))
            try:
                self.whole(name, room / "out", again=True, make=False)
            except AssertionError as error:
                self.problem(name, "full disk", f"{what}: {error}")
                return
            good = self.equal(name, expected, room / "out")
            if not good:
                self.problem(name, "full disk", f"{what}: another result")
            else:
                self.counts[name, "full disk", "survived"] += 1


def processor_seconds(pid: int) -> float:
    """Of a process and those it started; a busy machine moves no moment."""
    with contextlib.suppress(OSError):  # it has ended
        fields = (
            Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
        )
        spent = sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
        started = (
            p.read_text().split()
            for p in Path(f"/proc/{pid}/task").glob("*/children")
        )
        return spent + sum(
            processor_seconds(int(one)) for some in started for one in some
        )
    return 0.0


def pages(folder: Path) -> int:
    """Of memory that a folder's files take in a tmpfs."""
    return sum(
        -(-path.stat().st_size // 4096)
        for path in folder.rglob("*")
        if path.is_file()
    )


def run(*arguments: str) -> None:
    subprocess.run(arguments, check=True, capture_output=True)


@contextlib.contextmanager
def mounted(folder: Path, size: int) -> Iterator[Path]:
    """A tmpfs of this many bytes."""
    folder.mkdir(exist_ok=True)
    run("mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder))
    try:
        yield folder
    finally:
        run("umount", "-l", str(folder))


def inputs(base: Path) -> None:
    """A project for `gsgan.prepare` and a capture for `gsgan.fit`."""
    from capture_scenes import write_project
    from make import write_tiny_capture

    write_project(base / "project", 3, 4, (64, 48))
    people = write_tiny_capture(
        base / "people", cameras=3, frames=4, size=(48, 48)
    )
    for left in ("labels", "body_pose.npz"):
        shutil.rmtree(people / left, ignore_errors=True)


def main() -> None:
    """Reads the command line, prepares the inputs, kills."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=240)
    parser.add_argument(
        "--disk", action="store_true", help="also full file systems (root only)"
    )
    parser.add_argument(
        "--only", default=",".join(STAGES), help="stages, separated by commas"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--work", type=Path, help="folder for the runs; else the system's"
    )
    parser.add_argument("--out", type=Path, default=Path("outputs/chaos"))
    given = parser.parse_args()
    names = given.only.split(",")
    if (
        any("{base}/run" in a for n in names for a in STAGES[n].arguments)
        or "evaluate" in names
    ):
        names += (
            [] if "train" in names else ["train"]
        )  # its run is the others' input
    with tempfile.TemporaryDirectory(
        prefix="gsgan-chaos-", dir=given.work
    ) as folder:
        chaos = Chaos(Path(folder), given.seed)
        chaos.base.mkdir()
        built, cache = cache_root() / "native", chaos.base / "cache"
        if built.is_dir():  # else the first child compiles the kernels
            shutil.copytree(built, cache / "native")
        os.environ["GSGAN_CACHE"] = str(cache)
        inputs(chaos.base)
        os.environ["COLUMNS"] = "120"
        remember_configs()
        truths = {}
        for name in sorted(names, key=lambda name: name != "train"):
            truths[name] = truth = chaos.prepare(name)
            if name == "train":
                shutil.copytree(
                    Path(folder) / "whole" / "train" / "run", chaos.base / "run"
                )
            print(
                f"{name}: {truth.seconds:.1f} s, {truth.operations} file operations",
                flush=True,
            )
        ways = [*(s.name for s in SIGNALS), "operation", "no space"]
        total = sum(STAGES[name].share for name in names)
        wanted = {
            name: round(given.kills * STAGES[name].share / total)
            for name in names
        }
        wanted |= {
            name: 0 for name in names if name not in given.only.split(",")
        }
        for i in range(3 * max(wanted.values())):
            for name in names:
                if chaos.kills(name) < wanted[name]:
                    chaos.kill(name, ways[i % len(ways)], truths[name])
            write(chaos, names, given.out)
        for share in (0.0, 0.2, 0.4, 0.6, 0.8, 0.95) if given.disk else ():
            for name in given.only.split(","):
                chaos.disk(name, truths[name].result, share)
    write(chaos, names, given.out)
    if chaos.problems:
        sys.exit(f"{len(chaos.problems)} kills were not survived")


def write(chaos: Chaos, names: list[str], out: Path) -> None:
    """The table: survived of tried, by stage and way."""
    ways = [*(s.name for s in SIGNALS), "operation", "no space", "full disk"]
    rows = []
    for name in [*names, "all"]:
        cells = []
        for chosen in [[way] for way in ways] + [ways]:
            found = [
                sum(
                    chaos.counts[n, w, what]
                    for w in chosen
                    for n in ([name] if name != "all" else names)
                )
                for what in ("survived", "lost")
            ]
            cells.append(f"{found[0]} of {sum(found)}")
        rows.append([name, *cells])
    out.mkdir(parents=True, exist_ok=True)
    lines = [[*row] for row in rows]
    header = ["command", *ways, "all"]
    text = "\n".join(
        "| " + " | ".join(cells) + " |"
        for cells in (header, ["---"] * len(header), *lines)
    )
    (out / "chaos.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
