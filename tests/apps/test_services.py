"""Loggers of services: Lightning's own classes, which need packages that extras install."""

import sys
from types import ModuleType

import pytest

from mvrecon.apps import config
from mvrecon.apps.config import compose
from mvrecon.core.parts import LOGGERS
from mvrecon.training.targets import instantiate

SERVICES = {"wandb": "WandbLogger", "mlflow": "MLFlowLogger"}


@pytest.mark.parametrize("service", SERVICES)
def test_a_logger_without_its_package_is_refused_with_the_name_of_the_extra(
    service, monkeypatch, capsys
):
    """In one line, before torch is loaded."""
    monkeypatch.setattr(config, "locate", lambda name: None)
    monkeypatch.setattr(sys, "argv", ["mvrecon-train", "experiment=smoke", f"logger={service}"])
    with pytest.raises(SystemExit):
        config.launch(lambda settings: pytest.fail("the task began"), "train")
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and f"pip install 'mvrecon[{service}]'" in lines[0]


@pytest.mark.parametrize("service", SERVICES)
def test_a_logger_of_a_service_is_lightnings_and_keeps_the_default_ones(
    service, tmp_path, monkeypatch
):
    """With a mock of the package, Lightning's class is built beside the default loggers."""
    package, tracking = ModuleType(service), ModuleType("mlflow.tracking")
    tracking.MlflowClient = lambda uri: uri
    monkeypatch.setitem(sys.modules, service, package)
    monkeypatch.setitem(sys.modules, "mlflow.tracking", tracking)
    name = SERVICES[service]
    monkeypatch.setattr(f"lightning.pytorch.loggers.{service}._{service.upper()}_AVAILABLE", True)
    nodes = compose("experiment=smoke", f"logger={service}")["logger"]
    assert set(nodes) == {"table", "board", service}
    logger = instantiate(nodes[service], tmp_path, LOGGERS, save_dir=str(tmp_path))
    assert type(logger).__name__ == name
    assert type(logger).__module__ == f"lightning.pytorch.loggers.{service}"
