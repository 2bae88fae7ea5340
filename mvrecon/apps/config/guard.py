"""Guard of configs: a config file from elsewhere sets mvrecon's settings, never Hydra's own.

Before it calls a task, Hydra builds callbacks, launchers and log handlers from its own section,
sets environment variables and makes folders. A file that a user fetched must not choose these; the
command line may. Hydra has no hook between composing and acting, so the guard replaces two of its
internal functions; `pyproject.toml` therefore asks for one exact version of Hydra.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from omegaconf import DictConfig, OmegaConf

from mvrecon.core.files.checks import plain_name, shown, yaml_of
from mvrecon.core.files.runs import leaves
from mvrecon.core.registry import hint

#: Keys of the section `hydra` that any file may set, or that Hydra fills in when it composes.
OPEN = {"mode", "verbose", "help", "sweeper.params", "runtime", "overrides", "job.override_dirname"}


@contextmanager
def guarded(
    main: Path, others: Sequence[Path], check: Callable[[DictConfig], None] | None = None
) -> Iterator[None]:
    """Context in which every config that Hydra composes is checked before Hydra acts on it.

    Args:
        main: the folder of mvrecon's own configs.
        others: further folders that are trusted: those of installed plugins.
        check: a further check of each composed config, which raises what it likes.

    Raises:
        PermissionError: a file from elsewhere sets what only the command line may, or reads
            environment variables.
        LookupError: a setting that the app does not use.
        Refused: a YAML file that is too large, or a `name` that leads out of the folder of outputs.
    """
    # fills the registry with classes of its own, other than those that an import gives
    Plugins.instance()
    files: Any = SourcesRegistry.instance().resolve("file")
    load, read = ConfigLoaderImpl.load_configuration, files.load_config
    trusted = {str(folder) for folder in (main, *others)}

    def loaded(loader: Any, config_name: str, overrides: list[str], **options: Any) -> DictConfig:
        def composed(of: list[str]) -> DictConfig:
            return load(loader, config_name, of, **options)

        config = composed(overrides)
        foreign = [
            s.path
            for s in config.hydra.runtime.config_sources
            if s.schema == "file" and s.path not in trusted
        ]
        if foreign:
            if not any((folder / f"{config_name}.yaml").is_file() for folder in (main, *others)):
                raise PermissionError(
                    f"--config-name={config_name} is no app of mvrecon's; choose an experiment=..."
                )
            check_foreign(config, foreign, overrides, composed)
        config = _named(used(config, composed([]) if overrides else config))
        if check is not None:
            check(config)
        return config

    def bounded(source: Any, config_path: str) -> Any:
        path = Path(source.path) / source._normalize_file_name(config_path)
        if source.path not in trusted and path.is_file():
            yaml_of(path)
        return read(source, config_path)

    ConfigLoaderImpl.load_configuration, files.load_config = loaded, bounded  # type: ignore[method-assign]
    try:
        yield
    finally:
        ConfigLoaderImpl.load_configuration, files.load_config = load, read


def used(config: DictConfig, app: DictConfig) -> DictConfig:
    """Return the config if every top-level key is one of the app's; Hydra itself accepts any
    `+key=...`.

    Raises:
        LookupError: a key that the app does not have, so that nothing would come of it; the message
            names it.
    """
    # `key in app` is false for a setting that the user has yet to give
    allowed = {str(key) for key in app}
    if unused := [str(key) for key in config if key not in allowed]:
        raise LookupError(
            f"This app does not use the setting {unused[0]!r}{hint(unused[0], allowed - {'hydra'})}"
        )
    return config


def _named(config: DictConfig) -> DictConfig:
    for part in str(config.name).split("/") if "name" in config else []:
        plain_name(part, f"The setting name={config.name}")
    return config


def check_foreign(
    config: DictConfig,
    folders: list[str],
    overrides: list[str],
    compose: Callable[[list[str]], DictConfig],
) -> None:
    """Check that files from elsewhere change neither Hydra's own section nor `out`, the folder that
    an app writes to.

    Raises:
        PermissionError: they differ, or the folders' files cannot be told apart.
        Refused: an `out` that is made of settings which lead out of the folder of outputs.
    """
    if any((Path(folder) / "hydra").exists() for folder in folders):
        raise PermissionError(
            f"{shown(folders)} has configs of Hydra's own; expected none in a folder of experiments"
        )
    if not any(
        source.provider == "main" and source.path not in folders
        for source in config.hydra.runtime.config_sources
    ):
        raise PermissionError(
            "--config-path and --config-name of other apps are not allowed; use --config-dir"
        )
    trusted = compose(
        [line for line in overrides if line.lstrip("+~").startswith(("hydra", "out="))]
    )
    section, expected = (dict(leaves(_hydra(c))) for c in (config, trusted))
    changed = sorted(
        name
        for keys in {**section, **expected}
        if section.get(keys) != expected.get(keys) and not _open(name := ".".join(map(str, keys)))
    )
    if changed:
        raise PermissionError(f"A config sets {shown(changed)}; only a command line may")
    if "out" in config and not any(line.startswith("out=") for line in overrides):
        for part in str(config.out).split("/"):
            plain_name(part, f"The setting out={config.out}")
    settings = OmegaConf.to_yaml(
        OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    )
    if "oc.env" in settings and not any("oc.env" in line for line in overrides):
        raise PermissionError(
            "A config reads environment variables by ${oc.env:...}; only a command line may"
        )


def _hydra(config: DictConfig) -> dict[str, Any]:
    """Hydra's own section as it is written, and the folder of outputs that it refers to."""
    written: Any = OmegaConf.to_container(config, resolve=False)
    return {key: written[key] for key in ("hydra", "out") if key in written}


def _open(key: str) -> bool:
    return any(f"{key}.".startswith(f"hydra.{prefix}.") for prefix in OPEN)
