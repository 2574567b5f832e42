"""The config folder, and the entry point of a command: start, errors, exit status."""

import errno
import hashlib
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import fields, is_dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Self, get_type_hints

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import (
    CompactHydraException,
    HydraException,
    InstantiationException,
)
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from hydra.utils import get_class, get_method, instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import (
    InterpolationResolutionError,
    OmegaConfBaseException,
)
from rich.console import Console

from gsgan.utils.errors import ConfigError, GsganError
from gsgan.utils.sweeps import note, run_job

FAILED = 1
# group of entry points of installed packages
CONFIG_ENTRY_POINTS = "gsgan.conf"
# compute capability: before it bfloat16 is emulated or refused
BFLOAT16_SINCE = 8, 0
# Bytes of the name of a sweep's folder: file systems take 255, and files beside it need some.
LONGEST_NAME = 200
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
ASSIGNED = re.compile(r"\+{0,2}[A-Za-z_][\w./@]*")  # the key of an override
# Keys that there are no longer, and what takes their place.
GONE = {
    "effects.generator": "a model has the parts that its name says, and model=splat_only is the "
    "one without a generator",
    "effects.gaussians_per_pixel": "model.generator.refine=true or false chooses whether the "
    "generator has a last level",
}
# An element of a list on the command line: in quotes, or up to the next comma.
ELEMENT = re.compile(r"""\s*('[^']*'|"[^"]*"|[^,]+?)\s*(?:,|$)""")
SWEEPS = ("-m", "--multirun")
# What OmegaConf would read as the value of another key, ${HOME}, and not as a call, ${now:%H}.
REFERENCE = re.compile(r"(\\*)\$\{(?![\w.]+:.*\})")

# Keys of a dataset that are paths, and where a config holds a dataset.
DATA_PATHS = ("root", "smpl", "source.avatar", "source.motion")
DATA_AT = ("data", "other_capture")
# Keys that are paths, or names that may be one, in any command: their values are text.
PATHS = frozenset(
    {
        "background",
        "calibration",
        "callbacks.remote.dirpath",
        "camera",
        "capture",
        "compare",
        "data_root",
        "data_smpl",
        "distil",
        "hydra.run.dir",
        "hydra.sweep.dir",
        "landmarks",
        "lpips.path",
        "masks",
        "mediapipe.folder",
        "mediapipe.python",
        "method",
        "motion",
        "other_capture",
        "out",
        "path",
        "predictions",
        "predictions_pattern",
        "report",
        "run",
        "runs",
        "skeleton",
        "smpl",
        "source",
        "training.perceptual.path",
        "upload",
        "verify",
        *(f"{at}.{key}" for at in DATA_AT for key in DATA_PATHS),
    }
)

# Of these, the keys that may hold a list; elsewhere [final] is the name of a folder.
PATH_LISTS = frozenset({"compare", "motion", "runs"})


def config_folder() -> Path:
    """conf/: inside the package when installed, beside src/ in a checkout.

    Raises:
        GsganError: when neither exists.
    """
    # An installed package has the folder inside, a checkout has it beside src/.
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "conf", package.parents[1] / "conf"):
        if (folder / "train.yaml").is_file():
            return folder
    raise GsganError(
        f"{package / 'conf'}: the config folder is missing; install gsgan again"
    )


class PackageConfigs(SearchPathPlugin):
    """Adds the config folders of installed packages to those of every command.

    A package names its folder, a Python module with YAML files, by an entry point of the group
    `CONFIG_ENTRY_POINTS`.
    """

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Appends the folders: a file of gsgan's own comes before one of the same name."""
        for point in entry_points(group=CONFIG_ENTRY_POINTS):
            search_path.append(provider=point.name, path=f"pkg://{point.value}")


Plugins.instance().register(PackageConfigs)


def defaults_of(command: str) -> DictConfig:
    """The options of a command, or of a choice such as ``effects/auto``, with their defaults,
    without Hydra's own entries."""
    options = OmegaConf.load(config_folder() / f"{command}.yaml")
    assert isinstance(options, DictConfig)
    for key in ("defaults", "hydra"):
        options.pop(key, None)
    return options


def with_defaults(command: str, given: Mapping[str, Any]) -> DictConfig:
    """The options of a command, its defaults where none are given."""
    options = defaults_of(command)
    options.merge_with(given)
    return options


class CommandOptions:
    """Options of a command: a dataclass whose fields have the names of keys in its config.

    A group of the config is built as its ``_target_`` says. A field that is a class of options
    itself takes its values from the same config.
    """

    @classmethod
    def from_config(cls, config: DictConfig) -> Self:
        """The options of a config; those that it lacks take their defaults.

        Raises:
            GsganError: on a value that does not fit.
        """
        assert is_dataclass(cls)
        kinds = get_type_hints(cls)
        values: dict[str, Any] = {}
        for field in fields(cls):
            name = field.name
            kind = kinds[name]
            if isinstance(kind, type) and issubclass(kind, CommandOptions):
                values[name] = kind.from_config(config)
            elif name in config:
                values[name] = build(config[name])
        return cls(**values)


def build(value: Any, **further: Any) -> Any:
    """A value of a config as plain values, or as what it names with ``_target_``.

    Args:
        value: of a config.
        further: arguments of what it names.

    Raises:
        GsganError: when its constructor refuses it.
    """
    if not OmegaConf.is_config(value):
        return value
    # Hydra would resolve text with ${ twice.
    if OmegaConf.is_list(value) and all(isinstance(one, str) for one in value):
        return list(value)
    try:
        return instantiate(value, _convert_="all", **further)
    except InstantiationException as error:
        if isinstance(error.__cause__, GsganError):
            raise error.__cause__ from None
        raise ConfigError(str(one_sentence(error))) from error


def refuse_words_for_truth(config: DictConfig, defaults: DictConfig) -> None:
    """Refuses words such as ``no`` where the default is true or false: they would count as true."""
    for key, default in flat(OmegaConf.to_container(defaults, resolve=False)):
        value = OmegaConf.select(config, key)
        if isinstance(default, bool) and not isinstance(value, bool):
            raise ConfigError(f"{key} must be true or false, got {value!r}")


def refuse_gone(keys: Collection[str]) -> None:
    """Raises a ConfigError if one of the keys of a config or a command line is in `GONE`."""
    for key, instead in GONE.items():
        if key in keys:
            raise ConfigError(f"there is no {key} any more: {instead}")


def paths_as_text(config: DictConfig) -> None:
    """Makes text of numbers that a config file has at the keys of paths, such as ``root: 377``."""
    for key in PATHS:
        value = OmegaConf.select(config, key)
        if isinstance(value, (bool, int, float)):
            OmegaConf.update(config, key, str(value))
        elif isinstance(value, ListConfig):
            # Not resolved: text with ${ keeps its backslash.
            listed = OmegaConf.to_container(value, resolve=False) or ()
            OmegaConf.update(config, key, [str(path) for path in listed])


def flat(value: Any, at: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested mappings, by their dotted keys."""
    # An empty mapping is a value.
    if isinstance(value, Mapping) and value:
        for key, held in value.items():
            yield from flat(held, f"{at}.{key}" if at else str(key))
    else:
        yield at, value


def folder_name(overrides: str) -> str:
    """The folder name of a run in a sweep: its overrides, shortened, in characters that need no
    quotes in a shell or in ``run=<folder>``.

    A name that had to be changed ends in a digest of the overrides, so no two runs share a folder.
    """
    # Other characters need quotes in a shell.
    overrides = overrides or "defaults"
    name = re.sub(r"[^A-Za-z0-9_.+-]", "_", overrides)
    if name == overrides and len(name) <= LONGEST_NAME:
        return name

    # A changed name may be that of other overrides too, so a digest follows.
    end = "_" + hashlib.sha256(overrides.encode()).hexdigest()[:12]
    return name[: LONGEST_NAME - len(end)] + end


def if_gpu(then: object, otherwise: object) -> object:
    """The first value if CUDA is available, else the second."""
    import torch  # here: importing an entry point stays fast

    return then if torch.cuda.is_available() else otherwise


def gpu_precision() -> str:
    """The trainer's precision: bf16-mixed on a GPU that computes with bfloat16, else 32-true."""
    import torch  # here: importing an entry point stays fast

    if not torch.cuda.is_available():
        return "32-true"
    capability = torch.cuda.get_device_capability()
    return "bf16-mixed" if capability >= BFLOAT16_SINCE else "32-true"


def by_name(name: str, choices: Mapping[str, str], default: str) -> str:
    """The choice listed for a name, else the default."""
    return choices.get(name, default)


def capture_skeleton(root: str | None) -> str:
    """The skeleton with all landmarks that a capture has: body, hands, face."""
    if root is None or not (Path(root).expanduser() / "hands3d.npz").is_file():
        return "mediapipe33"
    has_face = (Path(root).expanduser() / "face3d.npz").is_file()
    return "holistic" if has_face else "mediapipe33_hands"


def capture_size(root: str | None, limit: int | None) -> int | None:
    """Pixels of the longest side of a capture's images, at most ``limit``."""
    cameras = Path(root or "").expanduser() / "cameras.json"
    if root is None or limit is None or not cameras.is_file():
        return limit
    try:
        sizes = [
            entry["size"] for entry in json.loads(cameras.read_text()).values()
        ]
        return min(limit, max(int(max(size)) for size in sizes))
    except (AttributeError, KeyError, TypeError, ValueError):
        return limit  # the reader says what is wrong with the file


# Functions that files in conf/ call, as in ${by_name:…}.
OmegaConf.register_new_resolver("by_name", by_name, replace=True)
OmegaConf.register_new_resolver("capture_size", capture_size, replace=True)
OmegaConf.register_new_resolver(
    "capture_skeleton", capture_skeleton, replace=True
)
OmegaConf.register_new_resolver("folder_name", folder_name, replace=True)
OmegaConf.register_new_resolver("gpu_precision", gpu_precision, replace=True)
OmegaConf.register_new_resolver("if_gpu", if_gpu, replace=True)


def entry(name: str, task: str, options: str) -> Callable[[], None]:
    """A command with Hydra's grammar and one-sentence errors.

    Each job of a sweep (``-m``) is the same command in a process of its own.

    Args:
        name: of the config file, without ``.yaml``, and of the command.
        task: the full name of a function of the options, which is imported when the command runs.
        options: the full name of its class of `CommandOptions`.
    """

    def run(config: DictConfig) -> float | None:
        try:
            # A sweep starts its jobs as processes.
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                return run_job(name, config.get("objective"))

            # Imports that take long begin here, so that --help is fast.
            import gsgan.utils.compat  # noqa: F401  (before lightning and torchmetrics)
            from gsgan.utils.tensors import keep_freed_memory

            keep_freed_memory()
            refuse_words_for_truth(config, defaults_of(name))
            plain = OmegaConf.to_container(config, resolve=False)
            refuse_gone(dict(flat(plain)))
            paths_as_text(config)
            kind: type[CommandOptions] = get_class(options)
            get_method(task)(kind.from_config(config))
        except KeyboardInterrupt:
            _print_error("interrupted")
            sys.exit(130)
        except Exception as error:
            # A bug keeps its traceback; the user's errors are one sentence.
            message = one_sentence(error)
            if message is None:
                raise
            _print_error(message)
            note(Path(HydraConfig.get().runtime.output_dir), message)
            _remove_unused_folder()
            sys.exit(FAILED)
        return None

    def main() -> None:
        import hydra  # here: importing an entry point stays fast

        # Keys that Hydra would refuse without naming what takes their place.
        given = [word.partition("=")[0].lstrip("+~") for word in sys.argv[1:]]
        try:
            refuse_gone(given)
        except ConfigError as error:
            _print_error(str(error))
            sys.exit(FAILED)

        # Paths that Hydra's grammar cannot read as they are; commas part the values of a sweep.
        sweep = any(option in sys.argv for option in SWEEPS)
        sys.argv[1:] = [quote(argument, sweep) for argument in sys.argv[1:]]
        command = hydra.main(
            version_base="1.3",
            config_path=str(config_folder()),
            config_name=name,
        )(run)

        # Errors come through to here, also those of files that Hydra itself writes.
        os.environ.setdefault("HYDRA_FULL_ERROR", "1")
        try:
            command()
        except CompactHydraException as error:
            # The cause names the key; Hydra's own sentence does not.
            cause = error.__cause__
            more = (
                f"\n{cause}"
                if isinstance(cause, OmegaConfBaseException)
                else ""
            )
            print(f"{error}{more}", file=sys.stderr)
            sys.exit(FAILED)
        except OSError as error:
            _end(error)
            sys.exit(FAILED)

    return main


def _end(error: OSError) -> None:
    """Prints the sentence of a system's error outside a command's task.

    Raises:
        OSError: the error, when it is a bug's.
    """
    # The reader of the output, such as head, has closed it.
    if isinstance(error, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return

    # The run folder that Hydra makes may be a file, or not writable.
    message = one_sentence(error)
    if message is None and error.filename is None:
        raise error
    _print_error(message or f"{error.filename}: {error.strerror}")


def quote(argument: str, sweep: bool = False) -> str:
    """``key=value`` in a form that Hydra's grammar reads as it was typed.

    The value of a key of `PATHS`, or each element of a list ``[a,b]`` of `PATH_LISTS`, is text: it
    is put in quotes if Hydra would read something else, such as a number. Other values are put in
    quotes where Hydra could not read them at all. A shell does not expand ``~/`` there, so it is
    expanded here.

    Args:
        argument: of the command line.
        sweep: whether commas part the values of a sweep.
    """
    # Options such as --help are no assignments.
    key, sign, value = argument.partition("=")
    if not sign or not ASSIGNED.fullmatch(key):
        return argument
    name = key.lstrip("+")

    # A backslash makes text of a reference to another key; keys of a group may have references.
    if name in PATHS and "." not in name:
        value = REFERENCE.sub(r"\1\1\\${", value)

    # A list of paths, each of them as typed.
    listed = value.startswith("[") and value.endswith("]")
    if name in PATH_LISTS and listed:
        elements = ELEMENT.findall(value[1:-1])
        return f"{key}=[{','.join(_as_text(path) for path in elements)}]"

    # Hydra's own grammar reads keys of other kinds, sweeps, and a capture that is given by keys.
    value = _expand(value)
    read = _read_by_hydra(f"{key}={value}")
    keys = name == "other_capture" and value.startswith("{")
    if read is not None and (
        name not in PATHS or keys or (sweep and read.is_sweep_override())
    ):
        return f"{key}={value}"

    # No value at all, or text; OmegaConf's mark of a missing value is none.
    if value == "null":
        return argument
    if value == "???":
        value = "./???"
    return f"{key}={_as_text(value)}"


def _as_text(value: str) -> str:
    """A value that Hydra reads as this text; one in quotes stays."""
    # Quotes that enclose the whole value are Hydra's.
    if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"":
        return value

    # Hydra may read the text as it is; backslashes mean more in a list.
    value = _expand(value)
    read = _read_by_hydra(f"key={value}")
    same = read is not None and not read.is_sweep_override()
    if same and read.value() == value and "\\" not in value:
        return value

    # The mark is one that the value does not contain, if there is one. Backslashes before a mark
    # would escape it.
    mark = '"' if "'" in value and '"' not in value else "'"
    value = re.sub(rf"(\\*)({mark}|$)", _escape, value)
    return mark + value + mark


def _escape(match: re.Match[str]) -> str:
    """Backslashes and the quote behind them, or the text's end, for a text in quotes."""
    backslashes, mark = match.groups()
    return 2 * backslashes + (f"\\{mark}" if mark else "")


def _expand(value: str) -> str:
    """The value with the user's folder for a leading ``~/``."""
    return str(Path(value).expanduser()) if value.startswith("~/") else value


def _read_by_hydra(argument: str) -> Any:
    """Hydra's `Override` of an argument, or None if its grammar cannot read it."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    try:
        return OverridesParser.create().parse_override(argument)
    except (HydraException, OmegaConfBaseException):
        return None


def one_sentence(error: BaseException) -> str | None:
    """The message for the user, or None for a bug, which keeps its traceback."""
    if isinstance(error, GsganError):
        return _without_worker(error)

    # The constructor of a class that a config names has failed.
    if isinstance(error, InstantiationException):
        cause = error.__cause__
        if isinstance(cause, GsganError):
            return str(cause)
        where = str(error).rpartition("full_key: ")[2] or "the config"
        if isinstance(cause, (ValueError, TypeError)):
            return f"{where}: {cause}"

        # Other errors may say little without the name of the class.
        which = str(error).splitlines()[0]
        return f"{where}: {which} {cause or ''}".rstrip()

    # A full disk, a bad override, or a value that gsgan refuses.
    if isinstance(error, OSError) and error.errno in NO_ROOM:
        return (
            f"{error.filename or 'a file'} cannot be written ({error.strerror}): make room, then "
            "start the same command again"
        )
    if isinstance(error, InterpolationResolutionError):
        where = f"{error.full_key}: " if error.full_key else ""
        return (
            f"{where}{str(error).splitlines()[0]}; ${{…}} takes the value of another key, so a "
            "path that holds it needs another name"
        )
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        return str(error).splitlines()[0]
    if isinstance(error, ValueError) and _is_ours(error):
        return str(error)
    return None


def _is_ours(error: BaseException) -> bool:
    """Whether a line of gsgan raised the error, about what it was given."""
    # The last entry of a traceback is the line that raised.
    at = error.__traceback__
    while at is not None and at.tb_next is not None:
        at = at.tb_next
    return at is not None and at.tb_frame.f_globals["__name__"].startswith(
        "gsgan."
    )


def _without_worker(error: GsganError) -> str:
    """The message without the traceback that a DataLoader's worker process puts before it."""
    text = str(error)
    if not text.startswith("Caught "):
        return text
    return (
        text.rpartition(f"{type(error).__name__}: ")[2]
        .strip()
        .rpartition("\n")[2]
    )


def _remove_unused_folder() -> None:
    """Removes the run folder that Hydra made if it has nothing but Hydra's files."""
    settings = HydraConfig.get()
    subfolder = settings.output_subdir
    if subfolder is None:  # the command has no run folder
        return
    folder = Path(settings.runtime.output_dir)
    if {path.name for path in folder.iterdir()} <= {
        subfolder,
        f"{settings.job.name}.log",
    }:
        shutil.rmtree(folder)


def _print_error(message: str) -> None:
    console = Console(stderr=True, soft_wrap=True)
    console.print(
        f"gsgan: {message}", style="bold red", markup=False, highlight=False
    )
