"""What the project itself promises: no call that runs data, nothing for the network, no version
with known holes.
"""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
CODE = sorted(
    f for folder in ("mvrecon", "scripts", "plugins") for f in (ROOT / folder).rglob("*.py")
)
#: Calls that run what they are given, whatever module or object they are an attribute of.
BANNED = {
    "eval",
    "exec",
    "load_from_checkpoint",
    "unsafe_load",
    "full_load",
    "Unpickler",
    "system",
    "popen",
}
PICKLES = {"pickle", "cPickle", "dill", "joblib", "cloudpickle", "shelve", "marshal"}


def calls(file: Path) -> Iterator[tuple[str, ast.Call]]:
    """Every call with its dotted name."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
            yield ast.unparse(node.func), node


def offences(file: Path) -> list[str]:
    """What runs or unpickles data in a file of code."""
    found = []
    for name, call in calls(file):
        given = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
        library, _, function = name.rpartition(".")
        if function in BANNED and not (function == "eval" and library) or name == "yaml.load":
            found.append(f"{call.lineno}: {name}")
        if name == "torch.load" and given.get("weights_only") != "True":
            found.append(f"{call.lineno}: torch.load without weights_only=True")
        if given.get("allow_pickle", "False") != "False" or given.get("shell", "False") != "False":
            found.append(f"{call.lineno}: {name} with {given}")
        if library in PICKLES and function in ("load", "loads"):
            found.append(f"{call.lineno}: {name}")
    return found


def test_no_code_executes_data():
    """The project's own tutorials, which are code, are run cell by cell, and nothing else."""
    offending = {str(f.relative_to(ROOT)): lines for f in CODE if (lines := offences(f))}
    assert [line.split()[-1] for line in offending.pop("scripts/docs/tutorials.py")] == ["exec"]
    assert offending == {}


@pytest.mark.parametrize(
    "line",
    [
        "eval(x)",
        "exec(x)",
        "os.system(x)",
        "torch.load(p)",
        "torch.load(p, weights_only=False)",
        "yaml.load(x, Loader)",
    ]
    + [
        "pickle.loads(x)",
        "np.load(p, allow_pickle=True)",
        "subprocess.run(x, shell=True)",
        "M.load_from_checkpoint(p)",
    ],
)
def test_the_search_finds_what_it_looks_for(line: str, tmp_path: Path):
    (tmp_path / "bad.py").write_text(f"{line}\n")
    assert offences(tmp_path / "bad.py")


def texts() -> list[Path]:
    """What a reader may copy a command from, and what runs."""
    folders = [
        f
        for folder in ("docs", "scripts", "conf", "experiments", "mvrecon", "plugins")
        for f in (ROOT / folder).rglob("*")
    ]
    kinds = (".md", ".sh", ".py", ".yaml", ".toml")
    return [
        f
        for f in [*ROOT.glob("*.md"), *ROOT.glob("*.toml"), *folders]
        if f.is_file() and f.suffix in kinds
    ]


def test_no_server_listens_on_the_network():
    found = [
        f
        for f in texts()
        if re.search(
            r"--bind[_-]all|0\.0\.0\.0|--host[= ](?!localhost|127\.0\.0\.1)", f.read_text()
        )
    ]
    assert [f.name for f in found if f.name != "SECURITY.md"] == []
    shown = [f.name for f in texts() if "tensorboard --logdir" in f.read_text()]
    assert {"README.md", "demo.sh"} <= set(shown)  # the search looks where the commands are


def test_the_board_listens_only_on_this_machine():
    from tensorboard import program

    board = program.TensorBoard()
    board.configure(argv=["tensorboard", "--logdir", "outputs"])
    assert (
        board.flags.bind_all is False and board.flags.host is None
    )  # TensorBoard then takes localhost


FLOORS = {
    "torch": (["2.10"], ["2.9.1"]),
    "lightning": (
        ["2.6.6"],
        ["2.6.2", "2.6.3", "2.6.5"],
    ),  # 2.6.2 and 2.6.3 ran foreign code when imported
    # before 1.3.6: a target by an alias of another module
    "hydra-core": (["1.3.6", "1.3.8", "1.4.1"], ["1.3.2", "1.3.5", "1.5"]),
    "h5py": (["3.14"], ["3.13"]),
    "pydicom": (["3.0.2"], ["3.0.1"]),
}


def requirements() -> dict[str, Requirement]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [
        *project["dependencies"],
        *(line for extra in project["optional-dependencies"].values() for line in extra),
    ]
    return {canonicalize_name(found.name): found for found in map(Requirement, lines)}


@pytest.mark.parametrize("name", FLOORS)
def test_versions_with_known_vulnerabilities_are_not_accepted(name: str):
    good, bad = FLOORS[name]
    specifier = requirements()[name].specifier
    assert all(specifier.contains(version) for version in good)
    assert not any(specifier.contains(version) for version in bad)


def test_what_is_imported_is_declared():
    import_names = {"pyyaml": "yaml", "pillow": "PIL", "hydra-core": "hydra"}
    import_names["simpleitk"] = "SimpleITK"
    declared = {import_names.get(name, name.replace("-", "_")) for name in requirements()}
    declared |= {"mvrecon", "scipy", "deepinv", "monai", "torchio"}  # adapters serve who has them
    modules: set[str] = set()
    for file in (ROOT / "mvrecon").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                modules |= {alias.name.partition(".")[0] for alias in node.names}
            if isinstance(node, ast.ImportFrom) and not node.level:
                modules.add((node.module or "").partition(".")[0])
    assert modules - declared - set(sys.stdlib_module_names) == set()


def pins(text: str) -> dict[str, str]:
    found = re.findall(r"^([A-Za-z0-9_.-]+)==([^\s;\\]+)", text, re.MULTILINE)
    return {canonicalize_name(name): version for name, version in found}


def test_the_lock_has_the_pinned_versions_with_hashes_and_names_no_index():
    text = (ROOT / "lock.txt").read_text()
    locked, pinned = pins(text), pins((ROOT / "constraints.txt").read_text())
    blocks = re.split(r"\n(?=\S)", text)
    assert all("--hash=sha256:" in block for block in blocks if "==" in block)
    assert not re.search(r"://|^-|--index|--find-links", text, re.MULTILINE)
    assert {
        name: version for name, version in locked.items() if pinned.get(name, version) != version
    } == {}
    assert {name for name in requirements() if name != "mvrecon"} <= set(locked)


def test_the_named_tests_of_the_security_note_exist():
    text = (ROOT / "SECURITY.md").read_text()
    named = set(re.findall(r"`(test_\w+)`", text))
    here = "".join(f.read_text() for f in (ROOT / "tests").rglob("test_*.py"))
    assert len(named) > 15 and not [name for name in named if f"def {name}(" not in here]


def test_shell_scripts_pass_the_syntax_check():
    for script in sorted((ROOT / "scripts").rglob("*.sh")):
        assert subprocess.run(["bash", "-n", script], check=False).returncode == 0
        assert "set -euo pipefail" in script.read_text()
