"""What `pip install .` installs: the code, the configs, the data files, the console scripts, the
licence.
"""

import configparser
import shutil
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """The wheel of this checkout, built without any download."""
    root, out = Path(__file__).parents[2], tmp_path_factory.mktemp("wheel")
    command = [
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--no-isolation",
        "--outdir",
        str(out),
        str(root),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return zipfile.ZipFile(next(out.glob("*.whl")))


def test_the_wheel_contains_all_code_configs_and_data(wheel: zipfile.ZipFile, root: Path):
    def wanted(folder: str) -> set[str]:
        found = (
            f for f in (root / folder).rglob("*") if f.is_file() and "__pycache__" not in f.parts
        )
        return {str(f.relative_to(root)) for f in found}

    held = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert held == wanted("mvrecon") | {f"mvrecon/{name}" for name in wanted("conf")}
    assert {
        "mvrecon/py.typed",
        "mvrecon/conf/train.yaml",
        "mvrecon/conf/experiment/quickstart.yaml",
    } <= held
    assert any(name.endswith(".csv") for name in held), "the dcspect80 geometry is missing"


def test_no_file_of_the_package_is_hidden_from_git(root: Path):
    if not (root / ".git").exists():
        pytest.skip("not a git checkout")
    command = ["git", "status", "--short", "--ignored", "--untracked-files=all", "mvrecon", "conf"]
    status = subprocess.run(
        command, cwd=root, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert not [line for line in status if line.startswith("!!") and "__pycache__" not in line]


def test_the_wheel_says_what_it_is(wheel: zipfile.ZipFile):
    import mvrecon

    folder = f"mvrecon-{mvrecon.__version__}.dist-info"
    metadata = Parser().parsestr(wheel.read(f"{folder}/METADATA").decode())
    assert metadata["License-Expression"] == "Apache-2.0"
    assert set(metadata["Requires-Python"].split(",")) == {">=3.11", "<3.14"}
    assert f"{folder}/licenses/LICENSE" in wheel.namelist()
    scripts = configparser.ConfigParser()
    scripts.read_string(wheel.read(f"{folder}/entry_points.txt").decode())
    assert dict(scripts["console_scripts"]) == {
        "mvrecon-train": "mvrecon.apps.train:main",
        "mvrecon-eval": "mvrecon.apps.eval:main",
        "mvrecon-simulate": "mvrecon.apps.simulate:main",
        "mvrecon-reconstruct": "mvrecon.apps.reconstruct:main",
        "mvrecon-list": "mvrecon.apps.list:main",
        "mvrecon-compare": "mvrecon.apps.compare:main",
        "mvrecon-warmup": "mvrecon.apps.warmup:main",
        "mvrecon-view": "mvrecon.apps.view:main",
    }


def test_an_unpacked_wheel_finds_its_own_configs(wheel: zipfile.ZipFile, tmp_path: Path):
    wheel.extractall(tmp_path)
    code = (
        "from mvrecon.apps.config import compose, conf_dir; print(conf_dir()); "
        "compose('experiment=quickstart')"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=900, check=False
    )
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()) == tmp_path / "mvrecon" / "conf"


def test_every_dependency_is_pinned(root: Path):
    import tomllib

    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    pins = {}
    for line in (root / "constraints.txt").read_text().splitlines():
        if line and not line.startswith("#"):
            pin = Requirement(line)
            pins[canonicalize_name(pin.name)] = next(iter(pin.specifier)).version
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    wanted = [
        *project["dependencies"],
        *(r for extra in project["optional-dependencies"].values() for r in extra),
    ]
    for requirement in map(Requirement, wanted):
        if requirement.name != "mvrecon":
            assert requirement.specifier.contains(pins[canonicalize_name(requirement.name)]), (
                requirement
            )


def test_the_environment_of_the_site_can_read_and_write_the_volumes_of_its_tutorials(root: Path):
    import tomllib

    from packaging.requirements import Requirement

    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]

    def brought(extra: str) -> set[str]:
        direct = list(map(Requirement, project["optional-dependencies"][extra]))
        nested = (brought(e) for r in direct if r.name == "mvrecon" for e in r.extras)
        return {r.name for r in direct}.union(*nested)

    assert brought("io") <= brought("docs")


def test_the_citation_and_the_hooks_have_the_versions_of_the_project(root: Path):
    import yaml

    import mvrecon

    citation = yaml.safe_load((root / "CITATION.cff").read_text())
    assert (citation["version"], citation["license"]) == (mvrecon.__version__, "Apache-2.0")
    pinned = (root / "constraints.txt").read_text().splitlines()
    hooks = yaml.safe_load((root / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    assert hooks and all(set(hook["additional_dependencies"]) <= set(pinned) for hook in hooks)


SHELL = """#!/bin/sh
# In place of Python and pip: makes .venv, writes down what it is to install;
# a CPU build of torch is there if $CPU is.
case "$*" in
*--version) echo "Python 3.11.0" ;;
"-m venv .venv") mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
*"pip "*)
    for last; do :; done
    case "$last" in *+cpu) [ -n "$CPU" ] || exit 1 ;; esac
    echo "$last" >>installed ;;
esac
"""
BUILDS = {
    "no GPU, a CPU build": ("", "yes", "torch==1.2+cpu", "0.2 GB"),
    "no GPU, no CPU build": ("", "", "torch==1.2", "PIP_EXTRA_INDEX_URL="),
    "a GPU": (
        "GPU 0: some",
        "yes",
        "torch==1.2",
        "There is an NVIDIA GPU: torch==1.2, the build of pip's",
    ),
}


@pytest.mark.parametrize("machine", BUILDS)
def test_the_set_up_reports_which_torch_it_installs_and_its_size(
    machine: str, root: Path, tmp_path: Path
):
    gpu, cpu, torch, message = BUILDS[machine]
    for name, text in {"python3.11": SHELL, "nvidia-smi": f"#!/bin/sh\necho '{gpu}'\n"}.items():
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    (tmp_path / "scripts").mkdir()
    for name, text in {
        "constraints.txt": "torch==1.2\ntorchmetrics==3\n",
        "pyproject.toml": "",
    }.items():
        (tmp_path / name).write_text(text)
    script = shutil.copy(root / "scripts" / "setup.sh", tmp_path / "scripts")
    environment = {"PATH": f"{tmp_path}:/usr/local/bin:/usr/bin:/bin", "CPU": cpu}
    done = subprocess.run(
        ["bash", script], env=environment, capture_output=True, text=True, timeout=900, check=False
    )
    assert done.returncode == 0, done.stderr
    assert message in done.stdout and " GB to download" in done.stdout
    assert (tmp_path / "installed").read_text().split() == [torch, ".[io]"]


def test_the_set_up_installs_missing_packages_once(root: Path, tmp_path: Path):
    """As `bash scripts/test.sh` and then `bash scripts/docs/site.sh` ask for it."""
    (tmp_path / "python3.11").write_text(SHELL)
    (tmp_path / "python3.11").chmod(0o755)
    (tmp_path / "scripts").mkdir()
    for name in ("constraints.txt", "pyproject.toml"):
        (tmp_path / name).write_text("torch==1.2\n")
    script = shutil.copy(root / "scripts" / "setup.sh", tmp_path / "scripts")
    environment = {"PATH": f"{tmp_path}:/usr/local/bin:/usr/bin:/bin", "CPU": "yes"}
    for extras in ("dev", "docs", "io", "dev", "docs"):
        subprocess.run(["bash", script, extras], env=environment, timeout=900, check=True)
    installed = (tmp_path / "installed").read_text().split()
    assert [what for what in installed if not what.startswith("torch")] == [".[dev]", ".[docs]"]


def test_the_set_up_uses_only_the_requested_python(root: Path, tmp_path: Path):
    for name, text in {
        "python3.11": SHELL,
        "old": "#!/bin/sh\necho Python 3.9.0; exit 1\n",
    }.items():
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    (tmp_path / "scripts").mkdir()
    for name in ("constraints.txt", "pyproject.toml"):
        (tmp_path / name).write_text("")
    script = shutil.copy(root / "scripts" / "setup.sh", tmp_path / "scripts")
    environment = {"PATH": f"{tmp_path}:/usr/local/bin:/usr/bin:/bin", "PYTHON": "old"}
    done = subprocess.run(
        ["bash", script], env=environment, capture_output=True, text=True, timeout=900, check=False
    )
    assert done.returncode == 1 and "found Python 3.9.0" in done.stderr
    assert not (tmp_path / ".venv").exists()
