"""`mvrecon-warmup` compiles all functions of a first training and an alignment."""

import pytest

SHORT = (
    "experiment=quickstart",
    "trainer.max_steps=2",
    "trainer.val_check_interval=1",
    "data.sizes={train: 4, val: 2, test: 2}",
    "data.workers=0",
)


@pytest.mark.long
def test_a_first_training_compiles_nothing_after_the_warm_up(tmp_path, monkeypatch, run_python):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    assert "compiling kernels" in run_python("-m", "mvrecon.apps.warmup").stderr
    training = ("-m", "mvrecon.apps.train", *SHORT, f"hydra.run.dir={tmp_path}/run")
    trained = run_python(*training)
    assert trained.returncode == 0 and "compiling kernels" not in trained.stderr, trained.stderr


WHERE = """
import sys
import numba.core.caching as caching
if sys.argv[1] == "nowhere":
    caching.CompileResultCacheImpl._locator_classes = []
if sys.argv[1] == "user":
    caching.CompileResultCacheImpl._locator_classes = [caching.UserWideCacheLocator]
import mvrecon.apps.warmup
import mvrecon.kernels.warps.cpu
mvrecon.apps.warmup.warm_up = lambda: 0.0
mvrecon.apps.warmup.main([])
"""


@pytest.mark.parametrize("place", ["beside", "user", "nowhere"])
def test_the_last_line_says_where_kernels_are(place, tmp_path, monkeypatch, run_python):
    """Beside the code, in numba's own folder where the code cannot be written, or nowhere; also
    tried: a package on a read-only disk, with and without a home that can be written.
    """
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    run = run_python("-c", WHERE, place)
    assert "Warning" not in run.stderr, run.stderr
    said = run.stdout
    expected = {"beside": "mvrecon/kernels", "user": f"in {tmp_path}", "nowhere": "are not kept"}
    assert expected[place] in said and ("kept in" in said) == (place != "nowhere"), said
