"""``python -m gsgan``: lists the commands."""

COMMANDS = {
    "gsgan.prepare": "make a dataset of your own videos: source=<folder> out=<folder>",
    "gsgan.check": "look a dataset over before training: data=capture data.root=<folder>",
    "gsgan.fit": "landmarks that fit the masks: data.root=<folder> out=<file.npz>",
    "gsgan.train": "train an avatar, then score it on what was held out",
    "gsgan.evaluate": "score a run, run=<folder>, or any method's pictures, predictions=<folder>",
    "gsgan.report": "tables of scored runs, runs=[<folder>,…], and figures of a run, run=<folder>",
    "gsgan.bench": "measure what things cost: raster, stability, fit, effects, speed, trade-off …",
}


def main() -> None:
    """Prints one line a command."""
    for name, what in COMMANDS.items():
        print(f"python -m {name:<16} {what}")
    print("Each answers --help with its choices and its whole config.")


if __name__ == "__main__":
    main()
