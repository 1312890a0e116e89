"""A checkpoint is written whole or not at all, and training resumes from it bit for bit."""

import json
import logging
import os

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save as to_safetensors

from learner import checkpoint
from learner.checkpoint import CheckpointError
from tmc.kernel.config import build, flat


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def tensors(trainer):
    return trainer.state().tensors


def equal(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def go_on(path, trainer):
    checkpoint.load(checkpoint.read(path), trainer)


@pytest.fixture
def trained(small, trainer_of, minibatch_of):
    """Return a trainer that has made some updates."""

    def make(updates=3, **values):
        trainer = trainer_of(small(values))
        for n in range(updates):
            trainer.update(minibatch_of(trainer.config, n, episodes=n))
        return trainer

    return make


def test_resuming_gives_the_same_weights_bit_for_bit(tmp_path, preset, trainer_of, minibatch_of):
    config = build({"dqn.target_episodes": 3}, preset)
    straight, first, second = trainer_of(config), trainer_of(config), trainer_of(build({"training.seed": 7}, config))
    for n in range(8):
        straight.update(minibatch_of(config, n, episodes=n))
    for n in range(4):
        first.update(minibatch_of(config, n, episodes=n))
    go_on(checkpoint.save(tmp_path, first), second)
    for n in range(4, 8):
        second.update(minibatch_of(config, n, episodes=n))
    assert equal(tensors(straight), tensors(second))
    assert (straight.updates, straight.copied) == (second.updates, second.copied) == (8, 6)


def test_counters_and_versions_come_back(tmp_path, trained):
    trainer, other = trained(3), trained(0)
    trainer.version = 11
    trainer.policy()
    go_on(checkpoint.save(tmp_path, trainer), other)
    assert (other.updates, other.version) == (3, 12)
    assert other.policy()[0] == 13


def test_the_file_says_what_it_is(tmp_path, trained):
    path = checkpoint.save(tmp_path, trained(3))
    assert names(tmp_path) == ["checkpoint-3.safetensors"]
    with safe_open(path, framework="pt") as file:
        meta = json.loads(file.metadata()["overfly"])
    assert (meta["format"], meta["updates"], meta["shape"]) == (1, 3, [3, 9, 9])
    assert meta["config"] == flat(trained(0).config)


def test_the_newest_three_are_kept(tmp_path, trained, minibatch_of):
    trainer = trained(8)
    for n in range(4):
        checkpoint.save(tmp_path, trainer)
        trainer.update(minibatch_of(trainer.config, n))
    assert names(tmp_path) == [f"checkpoint-{n}.safetensors" for n in (10, 11, 9)]
    assert checkpoint.newest(tmp_path).name == "checkpoint-11.safetensors"


def test_later_checkpoints_of_another_line_are_not_deleted(tmp_path, trained):
    later = checkpoint.save(tmp_path, trained(5))
    saved = checkpoint.save(tmp_path, trained(1))
    assert later.exists()
    assert saved.exists()


def test_no_folder_and_an_empty_folder_have_no_newest(tmp_path):
    assert checkpoint.newest(tmp_path) is None
    assert checkpoint.newest(tmp_path / "none") is None


def test_foreign_files_are_left_alone(tmp_path, trained):
    for name in ("checkpoint-best.safetensors", "notes.txt", "checkpoint--1.safetensors"):
        (tmp_path / name).write_text("mine")
    path = checkpoint.save(tmp_path, trained(1))
    assert checkpoint.newest(tmp_path).name == path.name
    assert len(names(tmp_path)) == 4


@pytest.mark.parametrize("step", ["fsync", "rename"])
def test_a_writer_killed_in_between_leaves_the_older_checkpoint(tmp_path, trained, monkeypatch, step):
    class Killed(BaseException):
        pass

    def kill(*args):
        raise Killed

    old = checkpoint.save(tmp_path, trained(2))
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", kill) if step == "fsync" else patch.setattr(type(old), "replace", kill)
        with pytest.raises(Killed):
            checkpoint.save(tmp_path, trained(3))
    assert names(tmp_path) == ["checkpoint-2.safetensors", "checkpoint-3.safetensors.new"]
    assert checkpoint.newest(tmp_path).name == old.name
    checkpoint.save(tmp_path, trained(4))
    assert names(tmp_path) == ["checkpoint-2.safetensors", "checkpoint-4.safetensors"]


def test_the_file_is_synced_before_it_is_renamed_and_the_folder_after(tmp_path, trained, monkeypatch):
    trainer, done = trained(0), []
    fsync, replace = os.fsync, type(tmp_path).replace
    monkeypatch.setattr(os, "fsync", lambda fd: (done.append("fsync"), fsync(fd))[1])
    monkeypatch.setattr(type(tmp_path), "replace", lambda a, b: (done.append("rename"), replace(a, b))[1])
    checkpoint.save(tmp_path, trainer)
    assert done == ["fsync", "rename", "fsync"]


@pytest.mark.parametrize("left", [0, 1, 7, 100, 2000, -1])
def test_a_truncated_checkpoint_is_skipped_with_a_sentence(tmp_path, trained, caplog, left):
    old, new = checkpoint.save(tmp_path, trained(2)), checkpoint.save(tmp_path, trained(3))
    new.write_bytes(new.read_bytes()[:left])
    with caplog.at_level(logging.WARNING):
        assert checkpoint.newest(tmp_path).name == old.name
    assert "checkpoint-3.safetensors is damaged or cut short: delete it" in caplog.text
    with pytest.raises(CheckpointError, match="damaged"):
        go_on(new, trained(0))


def test_a_flipped_bit_anywhere_is_found(tmp_path, trained):
    path = checkpoint.save(tmp_path, trained(1))
    whole = path.read_bytes()
    for at in [*range(0, len(whole), 997), len(whole) - 1]:
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises(CheckpointError):
            checkpoint.read(path)
    path.write_bytes(whole)
    checkpoint.read(path)


def test_a_folder_in_the_place_of_a_checkpoint_is_skipped(tmp_path, trained):
    (tmp_path / "checkpoint-9.safetensors").mkdir()
    assert checkpoint.newest(tmp_path) is None


def test_a_missing_file_is_named(tmp_path, trained):
    with pytest.raises(CheckpointError, match="there is no checkpoint"):
        go_on(tmp_path / "checkpoint-1.safetensors", trained(0))


@pytest.mark.parametrize(
    "values, text",
    [
        ({"network.dense": 9}, "network.dense = 8, this mission has 9"),
        ({"network.channels": (4, 7)}, r"network.channels = \[4, 6\], this mission has \[4, 7\]"),
        ({"observation.near": 2}, "observation.near = 1, this mission has 2"),
        ({"observation.radius": 5}, r"shape \(3, 9, 9\), this mission has \(3, 11, 11\)"),
    ],
)
def test_a_checkpoint_of_another_network_is_refused_and_changes_nothing(tmp_path, trained, values, text):
    path, other = checkpoint.save(tmp_path, trained(2)), trained(1, **values)
    before = tensors(other)
    with pytest.raises(CheckpointError, match=f"{text}: choose the settings it was made with"):
        go_on(path, other)
    assert equal(before, tensors(other))
    assert other.updates == 1


def test_settings_that_do_not_shape_the_network_may_change(tmp_path, trained):
    path, other = checkpoint.save(tmp_path, trained(2)), trained(0, **{"dqn.learning_rate": 1e-4})
    go_on(path, other)
    assert other.updates == 2
    assert other.adam.lr == 1e-4


def test_a_foreign_format_is_named(tmp_path, trained):
    path = tmp_path / "checkpoint-1.safetensors"
    path.write_bytes(to_safetensors(tensors(trained(0)), {"overfly": json.dumps({"format": 2})}))
    with pytest.raises(CheckpointError, match="has format 2, this Overfly reads format 1"):
        checkpoint.read(path)
