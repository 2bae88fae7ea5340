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
