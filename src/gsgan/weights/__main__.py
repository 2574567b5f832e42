"""``python -m gsgan.weights``: list the pretrained weights, and get those that are missing."""

from collections.abc import Sequence
from dataclasses import dataclass

from gsgan.utils.config import CommandOptions, entry


@dataclass(frozen=True)
class WeightsOptions(CommandOptions):
    """The options of gsgan.weights: conf/weights.yaml."""

    nets: Sequence[str]
    path: str | None
    download: bool


def list_weights(options: WeightsOptions) -> None:
    """Prints where each network's weights are found, and downloads those that are missing.

    Raises:
        ConfigError: on an unknown network.
        DataError: if weights cannot be used or got; the other networks are listed first.
    """
    from gsgan.utils.console import make_console
    from gsgan.utils.errors import DataError
    from gsgan.weights import files
    from gsgan.weights.networks import load_pretrained

    console = make_console()
    problems = []
    for net in options.nets:
        # On this machine, or else downloaded.
        title = files.network_of(net).title
        try:
            path = files.find(net, options.path)
            if path is None and options.download:
                path = files.get(net)
            if path is None:
                raise DataError(
                    f"{title} is not on this machine: {files.how_to_get(net)}"
                )

            # A wrong or damaged file is refused by the network.
            load_pretrained(net, path.path)
        except DataError as error:
            problems.append(str(error))
            console.print(f"{title}: missing", highlight=False)
        else:
            line = f"{title}: from {path.source}, {path.path}"
            console.print(line, highlight=False, markup=False, soft_wrap=True)
    console.print("LPIPS' heads: from torchmetrics", highlight=False)
    if problems:
        raise DataError("; ".join(problems))


main = entry(
    "weights",
    task="gsgan.weights.__main__.list_weights",
    options="gsgan.weights.__main__.WeightsOptions",
)

if __name__ == "__main__":
    main()
