"""The ends of an epoch, of an accumulation and of a call: none changes a bit of the training.

Five batches per epoch. Tried by hand as well: validation by epochs, `limit_train_batches`, two
processes that are killed within an accumulation, and EarlyStopping.
"""

import csv
import signal
from copy import deepcopy
from functools import cache
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch.callbacks import timer

from mvrecon.apps.config import compose
from mvrecon.training import checkpoints, fit, run_folder
from mvrecon.training.module import ReconstructionModule
from mvrecon.training.resume import extend_training, extended
from mvrecon.training.settings import TrainSettings
from tests.faults.fault_injection import counted, different, raising
from tests.training import lives

#: Plain steps at a constant rate; every step is logged.
PLAIN = [
    *(o for o in lives.OPTIONS if not o.startswith(("callbacks=", "trainer.max", "trainer.val"))),
    *("optimizer.schedule=constant", "optimizer.warmup=0", "trainer.log_every_n_steps=1"),
]
STEPS = 12
KINDS = {
    "validated within epochs": ("trainer.val_check_interval=3",),
    "validated at their ends": ("trainer.val_check_interval=5", "data.workers=1"),
    "never validated": ("+trainer.limit_val_batches=0",),
    "short epochs": ("trainer.val_check_interval=3", "+trainer.limit_train_batches=3"),
    "accumulated": ("trainer.val_check_interval=4", "trainer.accumulate_grad_batches=3"),
}


@cache
def composed(*options):
    return TrainSettings(**compose(*PLAIN, *options))


def begun(folder, *options):
    """The settings of a run, which its folder holds."""
    settings = deepcopy(composed(*options))
    folder.mkdir(parents=True)
    run_folder.start(folder, vars(settings))
    return settings


def lengthened(settings, folder, steps):
    """The settings of a run extended to more steps."""
    longer = extended(settings, folder, steps)
    extend_training(settings, longer, folder)
    return longer


def train(settings, folder):
    fit.fit(lives.METHOD, settings, fit.build_data(settings), folder)


def broken(settings, folder, step, call, happens=None, error=MemoryError):
    """Train until a call of a step, in which something happens, an error by default."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ReconstructionModule, step, getattr(ReconstructionModule, step))
        counted(ReconstructionModule, step, call, happens or raising(error()))
        with pytest.raises(error):
            train(settings, folder)


def logged(folder):
    """The losses of a run by their steps."""
    with open(folder / "metrics.csv", newline="") as file:
        return [
            (row["step"], row["loss/total"]) for row in csv.DictReader(file) if row["loss/total"]
        ]


def same(one, other):
    """Whether two runs end with the same bits, but for Lightning's own counts."""
    found = different(lives.state(one), lives.state(other))
    return [place for place in found if "/fit_loop/" not in place] == []


@pytest.fixture(scope="module", params=KINDS)
def whole(request, tmp_path_factory):
    """The options and the folder of an uninterrupted training."""
    options, folder = KINDS[request.param], tmp_path_factory.mktemp("whole") / "run"
    train(begun(folder, f"trainer.max_steps={STEPS}", *options), folder)
    return options, folder


def test_a_run_extended_from_any_step_is_one_of_the_whole_length(whole, request, tmp_path):
    """Five and seven steps, in turn: at the end of an epoch, and within one."""
    short = (5, 7)[[*KINDS].index(request.node.callspec.params["whole"]) % 2]
    options, expected = whole
    settings = begun(tmp_path / "run", f"trainer.max_steps={short}", *options)
    train(settings, tmp_path / "run")
    train(lengthened(settings, tmp_path / "run", STEPS), tmp_path / "run")
    assert same(tmp_path / "run", expected) and logged(tmp_path / "run") == logged(expected)


def test_a_run_stopped_by_a_signal_or_an_error_resumes_exactly(whole, tmp_path):
    """SIGTERM in the last batch of an epoch, which is within an accumulation of three batches; then
    an error in the next epoch.
    """
    options, expected = whole
    settings = begun(tmp_path / "run", f"trainer.max_steps={STEPS}", *options)
    for call, happens, error in (
        (5, lives.signalled(signal.SIGTERM), SystemExit),
        (4, raising(MemoryError()), MemoryError),
    ):
        broken(settings, tmp_path / "run", "training_step", call, happens, error)
    train(settings, tmp_path / "run")
    assert same(tmp_path / "run", expected) and logged(tmp_path / "run") == logged(expected)


def test_a_run_broken_in_epoch_after_epoch_resumes_exactly(whole, tmp_path):
    """Errors in the first batch of an epoch, of which the one before began after another error: its
    order of cases was that of the epoch before. Tried at random: 100 trainings with up to 11 breaks
    by errors, signals and time limits, in steps and validations, of 1 to 9 batches per epoch.
    """
    options, expected = whole
    settings = begun(tmp_path / "run", f"trainer.max_steps={STEPS}", *options)
    for call in (6, 6):
        broken(settings, tmp_path / "run", "training_step", call)
    train(settings, tmp_path / "run")
    assert same(tmp_path / "run", expected) and logged(tmp_path / "run") == logged(expected)


@pytest.mark.parametrize(
    "broken_in",
    [
        ("validation_step", 1),
        ("training_step", 5, lives.signalled(signal.SIGTERM), SystemExit),
        ("training_step", 10, lives.signalled(signal.SIGTERM), SystemExit),
    ],
)
def test_only_validated_epochs_are_validated_whatever_is_interrupted(broken_in, tmp_path):
    """Validated every other epoch: the checkpoint at the end of a validated epoch is that after its
    validation. Also stopped by a signal in the last step of either epoch.
    """
    options = ("+trainer.check_val_every_n_epoch=2", "trainer.val_check_interval=1.0")
    settings = begun(tmp_path / "run", f"trainer.max_steps={STEPS}", *options)
    broken(settings, tmp_path / "run", *broken_in)
    train(settings, tmp_path / "run")
    with open(tmp_path / "run" / "metrics.csv", newline="") as file:
        assert [row["step"] for row in csv.DictReader(file) if row["val/psnr"]] == ["9"]


def test_a_run_folder_that_has_moved_keeps_its_best_checkpoint(tmp_path):
    """The best validation is the first one. Lightning forgot it, and the next one replaced it."""
    best = "_target_: lightning.pytorch.callbacks.ModelCheckpoint, dirpath: best, filename: best"
    rule = "monitor: time/seconds, mode: min, enable_version_counter: false"
    options = (f"trainer.max_steps={STEPS}", f"+callbacks.best={{{best}, {rule}}}")
    settings = begun(tmp_path / "run", *options, "trainer.val_check_interval=3")
    broken(settings, tmp_path / "run", "training_step", 5)
    (tmp_path / "run").rename(tmp_path / "moved")
    train(settings, tmp_path / "moved")
    assert checkpoints.read(tmp_path / "moved" / "best" / "best.ckpt")["global_step"] == 3
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("last", [5, 7])
@pytest.mark.parametrize("whole", ["validated within epochs"], indirect=True)
def test_a_run_stopped_in_its_last_step_can_be_extended(whole, last, tmp_path):
    """SIGTERM in the last step, at the end of an epoch or within one: the run is resumed, which
    ends it, and extended.
    """
    (options, expected), folder = whole, tmp_path / "run"
    settings = begun(folder, f"trainer.max_steps={last}", *options)
    terminate = lives.signalled(signal.SIGTERM)
    broken(settings, folder, "training_step", last, terminate, SystemExit)
    train(settings, folder)
    train(lengthened(settings, folder, STEPS), folder)
    assert same(folder, expected) and logged(folder) == logged(expected)


@pytest.mark.parametrize("whole", ["short epochs", "accumulated"], indirect=True)
def test_a_time_limit_interrupts_and_each_call_gets_as_much_again(whole, tmp_path, monkeypatch):
    """A run stopped by `max_time` is not finished; resumed calls end with the bits of one call."""
    options, expected = whole
    limit, clock = "+trainer.max_time={milliseconds: 250}", SimpleNamespace(now=0.0)
    settings = begun(tmp_path / "run", f"trainer.max_steps={STEPS}", limit, *options)
    step = ReconstructionModule.training_step

    def slow(self, batch, batch_idx):
        clock.now += 0.03 / settings.trainer.get("accumulate_grad_batches", 1)
        return step(self, batch, batch_idx)

    monkeypatch.setattr(timer, "time", SimpleNamespace(monotonic=lambda: clock.now))
    monkeypatch.setattr(ReconstructionModule, "training_step", slow)
    done, calls = checkpoints.finished(tmp_path / "run", lives.METHOD), 0
    while not done.exists():
        calls += 1
        try:
            train(settings, tmp_path / "run")
        except InterruptedError as stop:
            assert not done.exists() and f"of {STEPS} steps" in str(stop)
            assert "resumes it" in stop.__notes__[0]
    assert calls == 2 and same(tmp_path / "run", expected)
    assert logged(tmp_path / "run") == logged(expected)


def test_early_stopping_ends_a_training(tmp_path):
    """Such a run is finished; extended, with another goal, a time limit stops it."""
    early = "{_target_: lightning.pytorch.callbacks.EarlyStopping, monitor: val/psnr, mode: max, "
    options = ("trainer.val_check_interval=2", f"+callbacks.early={early} stopping_threshold: 1}}")
    settings = begun(tmp_path / "run", f"trainer.max_steps={STEPS}", *options)
    train(settings, tmp_path / "run")
    assert lives.state(tmp_path / "run")["global_step"] == 2
    longer = lengthened(settings, tmp_path / "run", 2 * STEPS)
    longer.callbacks["early"]["stopping_threshold"] = 1000.0
    longer.trainer["max_time"] = {"milliseconds": 1}
    with pytest.raises(InterruptedError, match=f"after 3 of {2 * STEPS} steps"):
        train(longer, tmp_path / "run")


@pytest.mark.parametrize("each", [2, 7])
def test_every_step_takes_as_many_batches_across_the_ends_of_epochs(each, tmp_path, monkeypatch):
    """Three steps of plain gradient descent equal those by the means of the gradients of as many
    batches each; with more batches in a step than in an epoch, too.
    """
    batches, step = [], ReconstructionModule.training_step
    weights = []

    def seen(self, batch, batch_idx):
        weights.append([p.detach().clone() for p in self.parameters()])
        batches.append(batch)
        return step(self, batch, batch_idx)

    monkeypatch.setattr(ReconstructionModule, "training_step", seen)
    settings = begun(
        tmp_path / "run",
        "optimizer=sgd",
        *("optimizer.schedule=constant", "optimizer.warmup=0", "optimizer.lr=1e-3"),
        *("trainer.max_steps=3", f"trainer.accumulate_grad_batches={each}"),
        *("+trainer.limit_val_batches=0", "trainer.gradient_clip_val=null"),
    )
    settings.optimizer = {"name": "sgd", "lr": 1e-3, "schedule": "constant"}
    train(settings, tmp_path / "run")
    assert len(batches) == 3 * each
    data = fit.build_data(settings)
    module = fit.build_module(settings, settings.method, data.data_range)
    for n in range(0, len(batches), each):
        with torch.no_grad():
            for p, value in zip(module.parameters(), weights[n], strict=True):
                p.copy_(value)
        module.zero_grad()
        sum(module.terms(batch)["total"] / each for batch in batches[n : n + each]).backward()
        expected = [p - 1e-3 * p.grad for p in module.parameters()]
        after = weights[n + each] if n + each < len(batches) else _last(tmp_path / "run", module)
        for p, q in zip(after, expected, strict=True):
            assert torch.allclose(p, q, rtol=1e-6, atol=1e-9)


def _last(folder, module):
    state = checkpoints.read(checkpoints.finished(folder, lives.METHOD))["state_dict"]
    return [state[name] for name, _ in module.named_parameters()]


def test_a_schedule_over_epochs_counts_whole_steps(tmp_path):
    """Three epochs of five batches are three steps of four batches, over which a cosine falls to
    zero.
    """
    options = ("trainer.max_steps=-1", "trainer.max_epochs=3", "optimizer.schedule=cosine")
    settings = begun(tmp_path / "run", *options, "trainer.accumulate_grad_batches=4")
    train(settings, tmp_path / "run")
    state = lives.state(tmp_path / "run")
    assert state["global_step"] == 3
    assert state["optimizer_states"][0]["param_groups"][0]["lr"] == pytest.approx(0, abs=1e-12)
