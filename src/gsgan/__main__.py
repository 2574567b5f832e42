"""``python -m gsgan``: lists the commands."""

COMMANDS = {
    "gsgan.train": "train an avatar, then score it on what was held out",
    "gsgan.evaluate": "score a trained run: run=<folder>",
}


def main() -> None:
    """Prints one line a command."""
    for name, what in COMMANDS.items():
        print(f"python -m {name:<16} {what}")
    print("Each answers --help with its choices and its whole config.")


if __name__ == "__main__":
    main()
