"""The subcommands of `pregrasp-jax`; their docstrings are the help."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from pregrasp_jax import io
from pregrasp_jax.assets.catalogue import builtin_bank
from pregrasp_jax.assets.meshes import LoadedDir, load_object_dir
from pregrasp_jax.assets.sets import format_table
from pregrasp_jax.assets.variants import variant_bank
from pregrasp_jax.checkpoint.combine import combine as combine_policies
from pregrasp_jax.cli import doctor as machine_doctor
from pregrasp_jax.cli.outputs import refuse_unwritable
from pregrasp_jax.config import AssetsConfig, Config, ObjectSet, SceneConfig, TaskConfig
from pregrasp_jax.drawing import contact_sheet, save_image
from pregrasp_jax.evaluation import load_evaluation
from pregrasp_jax.evaluation.player import make_player
from pregrasp_jax.evaluation.statistics import compare as compare_evaluations
from pregrasp_jax.evaluation.statistics import format_comparison
from pregrasp_jax.evaluation_config import EvaluationConfig, TaskOverrides
from pregrasp_jax.messages import command
from pregrasp_jax.report.play import draw_decision, draw_scenes
from pregrasp_jax.robot import get_robot
from pregrasp_jax.scene.bank import SPLITS, SceneBank
from pregrasp_jax.startup import prepare
from pregrasp_jax.task.assembly import make_env
from pregrasp_jax.types import HullBank

_SHOWN_SCENES = 12
"""Scenes on the sheet of `scenes --png`."""


def assets(
    object_dir: Path | None = None,
    /,
    *,
    object_set: ObjectSet | None = None,
    variants: int = 0,
    png: Path = Path("assets.png"),
) -> None:
    """List the objects of a mesh folder (or the built-in ones): hulls, size, mass, whether they can be targets.

    Args:
        object_dir: folder of .obj/.stl/.ply/.glb/.gltf/.off/.dae meshes, or of folders with one each, with
            subfolders seen and unseen or without; the built-in catalogue if left out.
        object_set: only this set; all that there are if left out.
        variants: list instead so many objects made beside each set, as a training with `assets.variants` meets them.
        png: contact sheet of the objects, .png, .jpg, .jpeg or .webp; with two sets their names are added to that of
            the file.
    """
    refuse_unwritable(png, "image")
    Config(assets=AssetsConfig(variants=variants)).validate()
    prepare()
    names: Sequence[ObjectSet] = (object_set,) if object_set else _object_sets(object_dir)
    sets = [_load_objects(object_dir, name) for name in names]  # all are read before the first is written
    for name, loaded in zip(names, sets, strict=True):
        if variants:
            loaded = _made_beside(loaded, variants, object_dir, name)
        eligible, why_not = get_robot(TaskConfig().robot).eligibility(loaded.bank)
        file = png if len(names) == 1 else png.with_stem(f"{png.stem}-{name}")
        print(f"{name} ({object_dir or 'built in'})\n{format_table(loaded, why_not)}")
        if loaded.bank.names:
            _write_image(file, contact_sheet(loaded.bank, eligible))


def combine(policies: tuple[str, ...], /, *, out: Path, first: int = 0, any_values: bool = False) -> None:
    """Make one policy of several: the value of a push is the mean of theirs.

    Args:
        policies: two or more of one network, task and discount, or one with --first: run folders (the best policy of a
            run), their folders `checkpoints` (the latest), policy folders, pretrained, or cpu-1.
        out: folder of the new policy. It is evaluated, exported and trained on like any other.
        first: networks of each policy that count, the first ones; 0 takes all. Fewer take less time.
        any_values: take policies that were trained for other rewards and discounts, too. What they make together is to
            be trained on first (`train --init-from`).
    """
    policy = combine_policies(policies, out, first=first, any_values=any_values)
    count = policy.config.network.num_members
    print(f"wrote {out}: {f'the mean of {count} networks' if count > 1 else 'one network'}")


def compare(a: Path, b: Path, /, *, across_workspaces: bool = False, json: Path | None = None) -> None:
    """Compare two evaluations on the same scenes: intervals, and McNemar's exact test of their difference.

    Args:
        a: file written by `pregrasp-jax evaluate --json`.
        b: another, of the same scenes.
        across_workspaces: the two may be of different places, as the open table and a shelf.
        json: write the comparison here.
    """
    refuse_unwritable(json, "json")
    comparison = compare_evaluations(load_evaluation(a), load_evaluation(b), across_workspaces=across_workspaces)
    print(format_comparison(comparison))
    if json:
        io.write_json(json, comparison.to_dict())


def doctor() -> None:
    """Say what this machine offers: versions, engines, threads, cache, free memory and disk."""
    print(machine_doctor.format_description(machine_doctor.describe()))


def scenes(
    *,
    split: Literal["train", "validation", "test"] = "test",
    object_dir: str | None = None,
    object_set: ObjectSet = "seen",
    scene: SceneConfig = SceneConfig(),  # noqa: B008  (frozen)
    png: Path | None = None,
) -> None:
    """Describe a bank of packed scenes; it is packed if it does not exist yet.

    Args:
        split: which bank.
        object_dir: folder of meshes; the built-in catalogue if left out.
        object_set: objects used in training, or kept for evaluation.
        scene: how many scenes, how crowded.
        png: draw the first scenes here; .png, .jpg, .jpeg or .webp.
    """
    refuse_unwritable(png, "image")
    prepare()
    config = Config(assets=AssetsConfig(object_dir=object_dir, object_set=object_set), scene=scene).validate()
    env = make_env(config, split=split)
    print(describe_scenes(env.scenes, env.bank))
    if png:
        _write_image(png, draw_scenes(env, range(min(_SHOWN_SCENES, len(env.scenes)))))


def show(
    *,
    policy: str = "straight",
    scene: int = 0,
    pushes: int = 0,
    object_dir: str | None = None,
    object_set: ObjectSet = "seen",
    workspace: str | None = None,
    camera: Literal["orthographic", "pinhole"] | None = None,
    png: Path = Path("scene.png"),
) -> None:
    """Draw one decision: camera view, heightmaps, Q maps of a learned policy, and the push it chooses.

    Args:
        policy: who decides; a name or run folder as in `pregrasp-jax evaluate`.
        scene: test scene.
        pushes: let the policy push so often before the picture is taken.
        object_dir: folder of meshes; the built-in catalogue if left out.
        object_set: objects used in training, or kept for evaluation.
        workspace: where; the policy's own if left out, the open table for a script.
        camera: what the policy sees through.
        png: the picture; .png, .jpg, .jpeg or .webp.
    """
    refuse_unwritable(png, "image")
    if pushes < 0:
        raise ValueError(f"pushes = {pushes} is out of range; allowed is 0 and more")
    assets_config = AssetsConfig(object_dir=object_dir, object_set=object_set)
    task = TaskOverrides(workspace=workspace, camera=camera)
    player = make_player(EvaluationConfig(policy=policy, assets=assets_config, task=task))
    if not 0 <= scene < len(player.env.scenes):
        raise ValueError(f"scene = {scene} is out of range; allowed is 0 to {len(player.env.scenes) - 1}")
    _write_image(png, draw_decision(player, scene=scene, pushes=pushes))


def describe_scenes(scenes: SceneBank, bank: HullBank) -> str:
    """Return what a scene bank holds: size, acceptance, crowding, and how often each object stands or is wanted."""
    ids = np.asarray(scenes.object_ids)
    crowding = Counter(int(count) for count in (ids >= 0).sum(axis=1))
    wanted = Counter(int(i) for i in ids[np.arange(len(ids)), np.asarray(scenes.target)])
    present = Counter(int(i) for i in ids[ids >= 0])
    width = max(len(name) for name in ("object", *bank.names))
    return "\n".join(
        [
            f"{len(scenes)} {scenes.split} scenes, {len(scenes) / scenes.tries:.0%} of {scenes.tries} tries, "
            f"hash {scenes.content_hash}",
            "objects per scene: " + ", ".join(f"{count}: {crowding[count]}" for count in sorted(crowding)),
            f"{'object':<{width}}  scenes  target",
            *(f"{name:<{width}}  {present[i]:6d}  {wanted[i]:6d}" for i, name in enumerate(bank.names)),
        ]
    )


def _object_sets(object_dir: Path | None) -> list[ObjectSet]:
    """Return the sets a folder has; a flat folder is the seen set."""
    both: list[ObjectSet] = ["seen", "unseen"]
    return both if object_dir is None else [name for name in both if (object_dir / name).is_dir()] or ["seen"]


def _load_objects(object_dir: Path | None, object_set: ObjectSet) -> LoadedDir:
    return LoadedDir(builtin_bank(object_set)) if object_dir is None else load_object_dir(object_dir, object_set)


def _made_beside(loaded: LoadedDir, number: int, object_dir: Path | None, object_set: ObjectSet) -> LoadedDir:
    """Return the objects that a training makes beside loaded ones, with what is to be said of these."""
    if not loaded.bank.names:
        raise ValueError(
            f"{object_dir}: none of the {len(loaded.refusals)} meshes of '{object_set}' is usable, so none can be made "
            f"beside them; `{command('assets', object_dir)}` says why"
        )
    made = variant_bank(loaded.bank, number, seed=(SceneConfig().bank_seed, SPLITS.index("train")))
    return LoadedDir(made, loaded.refusals, loaded.notes, unused=loaded.unused)


def _write_image(path: Path, image: np.ndarray) -> None:
    """Write an image and say so."""
    save_image(path, image)
    print(f"wrote {path}")
