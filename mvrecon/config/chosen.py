"""The options of an experiment's own model are not those of a model that is chosen in its place."""

import re
from collections.abc import Callable, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf

#: Options that belong to no model, but to the cases that any of them is given.
OF_CASES = {"assume"}
#: A line of the command line that chooses the main model or a part of it, sets or removes options.
OF_MODEL = re.compile(r"[+~]*(\w+@)?model([.=]|$)")


def check_model_choice(
    config: DictConfig, overrides: Sequence[str], compose: Callable[[list[str]], DictConfig]
) -> None:
    """Check that a model which the command line chooses has the options of its own file.

    A table would call a model by its file, whatever an experiment had made of it.

    Args:
        config: composed.
        overrides: of the command line that it is composed of.
        compose: a config of other overrides.

    Raises:
        ValueError: the experiment sets options for a model of its own that the chosen model's file
            sets otherwise, or lacks, and the command line does not.
    """
    experiment, choice = (_choice(config, group) for group in ("experiment", "model"))
    of_model = [line for line in overrides if OF_MODEL.match(line)]
    if not experiment or not any(line.startswith("model=") for line in of_model):
        return
    own = _choice(compose([line for line in overrides if line not in of_model]), "model")
    if own == choice:
        return
    alone = [line for line in overrides if line.startswith("hydra.") or line in of_model]
    expected = _model(compose([line for line in alone if not line.startswith("~")]))
    options = _model(config)
    names = [key for key in options if key not in OF_CASES]
    if changed := [key for key in names if options[key] != expected.get(key)]:
        keys = ", ".join(f"model.{key}" for key in changed)
        lines = [f"model.{key}=..." if key in expected else f"~model.{key}" for key in changed]
        raise ValueError(
            f"experiment={experiment} sets {keys} of its model={own}; got model={choice}, "
            f"expected {' '.join(lines)} on the command line, too"
        )


def _choice(config: DictConfig, group: str) -> str | None:
    return config.hydra.runtime.choices.get(group)


def _model(config: DictConfig) -> dict[str, Any]:
    """The main model's options, references as they are written."""
    options: Any = OmegaConf.to_container(config.model, resolve=False)
    return options
