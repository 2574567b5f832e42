"""``python -m gsgan`` lists the commands; ``gsgan train …`` is ``python -m gsgan.train …``."""

import runpy
import sys

COMMANDS = {
    "gsgan.demo": "a picture and a video of a ready avatar, without training",
    "gsgan.prepare": "make a dataset from videos: source=<folder> out=<folder>",
    "gsgan.check": "check a dataset before training: data=capture data.root=<folder>",
    "gsgan.fit": "fit the body to a capture's masks: data=capture data.root=<folder>",
    "gsgan.train": "train an avatar, then score it on the held-out splits",
    "gsgan.evaluate": "score a run, run=<folder>, or any method's images, predictions=<folder>",
    "gsgan.render": "drive an avatar: run=<folder> motion=<file> out=<video.mp4|folder>",
    "gsgan.view": "look at an avatar in the browser, drag its joints: run=<folder>",
    "gsgan.export": "write .ply, .glb, .usdc, .html, .onnx, .bvh and more: run=<folder> out=<file>",
    "gsgan.report": "tables of scored runs, runs=[<folder>,…], and figures of a run, run=<folder>",
    "gsgan.weights": "find or download the networks of the perceptual loss and of LPIPS",
    "gsgan.bench": "measure milliseconds from skeleton to image: speed",
}


def main() -> None:
    """Runs the command that the first argument names; without one, prints one line per command."""
    if sys.argv[1:] in ([], ["-h"], ["--help"]):
        for name, what in COMMANDS.items():
            print(f"python -m {name:<16} {what}")
        print("Each prints its choices and its whole config with --help.")
        return

    # The command sees its own arguments, as after python -m.
    module = f"gsgan.{sys.argv.pop(1)}"
    if module not in COMMANDS:
        commands = ", ".join(name.removeprefix("gsgan.") for name in COMMANDS)
        sys.exit(f"{module} is not a command; expected one of {commands}")
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
