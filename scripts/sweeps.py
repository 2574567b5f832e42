"""A sweep of 20 tiny runs by a launcher, two of them killed, then the same sweep started again.

    python scripts/sweeps.py [joblib ray basic] [--runs 20] [--kills 2] [--at-once 2]

Needs the extra ``sweep``. A job is killed by SIGKILL, the first time it runs. The first sweep must
end with a score for every other job and name the killed ones; so must `gsgan.report`. The second
must score them all and write no score of the first again.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from chaos import TINY


def options(launcher: str, at_once: int) -> list[str]:
    """Hydra's of a launcher."""
    chosen = f"hydra/launcher={launcher}"
    if launcher == "joblib":
        return [chosen, f"hydra.launcher.n_jobs={at_once}"]
    return (
        [chosen, f"+hydra.launcher.ray.init.num_cpus={at_once}"]
        if launcher == "ray"
        else [chosen]
    )


def job(folder: Path) -> int | None:
    """The process that runs the job of a folder."""
    for entry in Path("/proc").iterdir():
        try:
            words = (
                (entry / "cmdline").read_bytes()
                if entry.name.isdigit()
                else b""
            )
        except OSError:  # it has just ended
            continue
        if f"hydra.run.dir='{folder}'".encode() in words:
            return int(entry.name)
    return None


def sweep(
    folder: Path, runs: int, given: list[str], seeds: set[int]
) -> tuple[int, str, list[str]]:
    """Exit status, output, and the names of the jobs of these seeds, killed as they appear."""
    every = ",".join(map(str, range(runs)))
    command = [
        sys.executable,
        "-m",
        "gsgan.train",
        "-m",
        *TINY,
        f"seed={every}",
    ]
    command += ["model=splat_only", f"hydra.sweep.dir={folder}", *given]
    log, killed = folder.with_suffix(".log"), dict[int, str]()
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "RAY_worker_niceness": "0",
    }
    with (
        log.open("w") as out,
        subprocess.Popen(command, stdout=out, stderr=out, env=environment) as p,
    ):
        while p.poll() is None:
            for config in folder.glob("*/.hydra/config.yaml"):
                found = re.search(
                    r"^seed: (\d+)$", config.read_text(), re.MULTILINE
                )
                seed = int(found[1]) if found else -1
                pid = (
                    job(config.parents[1])
                    if seed in seeds - killed.keys()
                    else None
                )
                if pid is not None:
                    os.kill(pid, signal.SIGKILL)
                    killed[seed] = config.parents[1].name
            time.sleep(0.2)
    return p.returncode, log.read_text(), list(killed.values())


def scores(folder: Path) -> dict[Path, tuple[int, int]]:
    """When each score was written, and its inode."""
    files = {path: path.stat() for path in folder.glob("*/metrics.json")}
    return {
        path: (found.st_mtime_ns, found.st_ino) for path, found in files.items()
    }


def hold(promise: bool, text: str) -> None:
    """Ends the script with the output where a promise does not hold."""
    if not promise:
        sys.exit(f"{text}\nnot survived")


def attempt(launcher: str, runs: int, kills: int, at_once: int) -> None:
    """One launcher: killed, named, started again."""
    with tempfile.TemporaryDirectory() as temporary:
        folder, given = Path(temporary) / "sweep", options(launcher, at_once)
        began = time.monotonic()
        status, text, killed = sweep(
            folder, runs, given, {3 + 4 * k for k in range(kills)}
        )
        first, minutes = scores(folder), (time.monotonic() - began) / 60
        print(f"{launcher}: {len(first)} of {runs} scored in {minutes:.1f} min")
        hold(
            status == 1 and len(first) == runs - kills == runs - len(killed),
            text,
        )
        words = [
            "-m",
            "gsgan.report",
            f"runs=[{folder}]",
            f"out={temporary}/report",
        ]
        report = subprocess.run(
            [sys.executable, *words],
            capture_output=True,
            text=True,
            check=False,
        )
        for output in (text, report.stdout + report.stderr):
            hold(
                all(name in output.replace("\n", "") for name in killed), output
            )
        print(
            f"{launcher}: the {kills} killed are named by the sweep and by the report"
        )
        status, text, _ = sweep(folder, runs, given, set())
        again = scores(folder)
        hold(
            status == 0
            and len(again) == runs
            and first.items() <= again.items(),
            text,
        )
        print(
            f"{launcher}: started again, {len(again)} scored, none written again"
        )


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("launchers", nargs="*", default=["joblib", "ray"])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--kills", type=int, default=2)
    parser.add_argument("--at-once", type=int, default=2)
    given = parser.parse_args()
    for launcher in given.launchers:
        attempt(launcher, given.runs, given.kills, given.at_once)


if __name__ == "__main__":
    main()
