"""Each default has one place: the YAML files; Python has none for a key that one of them gives."""

import inspect
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml

import gsgan.utils.compat  # noqa: F401  (before anything imports torchvision)

CONF = Path(__file__).parents[1] / "conf"
FROM_PYTHON = "is made from Python too, as the docs say"
STATES = "a file states what differs from gsgan's own scores, or from a table of everything"
# Classes and functions whose Python defaults stay, with the reason.
EXEMPT = {
    "gsgan.data.crop.PersonCrop": "crop=person names it without its margin",
    "gsgan.data.datamodule.GsganData": FROM_PYTHON,
    "gsgan.data.formats.avatarrex.AvatarrexReader": FROM_PYTHON,
    "gsgan.data.formats.capture.CaptureReader": FROM_PYTHON,
    "gsgan.data.formats.consistency.Consistency": FROM_PYTHON,
    "gsgan.data.formats.easymocap.EasymocapReader": FROM_PYTHON,
    "gsgan.data.formats.thuman4.Thuman4Reader": FROM_PYTHON,
    "gsgan.data.formats.zju.ZjuReader": FROM_PYTHON,
    "gsgan.data.metric_variants.MetricVariants": STATES,
    "gsgan.data.protocol.Protocol": STATES,
    "gsgan.report.spec.TableSpec": STATES,
    "gsgan.skeleton.Densify": FROM_PYTHON,
    "gsgan.splat.settings.Accuracy": FROM_PYTHON,
    "gsgan.synthetic.scenes.ensure_scene": FROM_PYTHON,
    "gsgan.train.optimisers.Recipe.span": "is read for two of five optimisers",
}
# Options of commands, which have no _target_, and the commands that all must have their keys.
OPTIONS = {
    "gsgan.bench.speed.SpeedOptions": ("bench_speed",),
    "gsgan.check.run.CheckOptions": ("check",),
    "gsgan.evaluate.run.EvaluateOptions": ("evaluate",),
    "gsgan.evaluate.run.ScoreOptions": ("evaluate", "train"),
    "gsgan.prepare.options.Options": ("prepare",),
    "gsgan.train.run.TrainOptions": ("train",),
}


def targets(node: Any) -> Iterator[tuple[str, set[str]]]:
    """What a file builds, and the arguments that it gives."""
    if isinstance(node, dict):
        if "_target_" in node:
            yield node["_target_"], {key for key in node if key[0] != "_"}
        node = list(node.values())
    if isinstance(node, list):
        for value in node:
            yield from targets(value)


def defaults(path: str) -> set[str]:
    """The parameters with a default in Python."""
    module, name = path.rsplit(".", 1)
    parameters = inspect.signature(
        getattr(import_module(module), name)
    ).parameters
    return {
        name
        for name, parameter in parameters.items()
        if parameter.default is not inspect.Parameter.empty
    }


def test_python_has_no_default_for_a_key_of_yaml():
    twice = set()
    for path in sorted(CONF.rglob("*.yaml")):
        for target, keys in targets(yaml.safe_load(path.read_text())):
            if target.startswith("gsgan.") and target not in EXEMPT:
                twice |= {f"{target}.{key}" for key in keys & defaults(target)}
    assert twice <= EXEMPT.keys()


@pytest.mark.parametrize(("options", "commands"), OPTIONS.items())
def test_options_have_no_default_for_a_key_of_their_commands(options, commands):
    keys = []
    for command in commands:
        config = yaml.safe_load((CONF / f"{command}.yaml").read_text())
        groups = [
            next(iter(x)) for x in config["defaults"] if isinstance(x, dict)
        ]
        keys.append({*config, *groups})
    # data and protocol are choices that may be none
    assert not defaults(options) & set.intersection(*keys) - {
        "data",
        "protocol",
    }
