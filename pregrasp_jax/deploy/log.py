"""Every decision on disk with all that it followed from, so that a failed trial can be looked at, and drawn.

LOG/decision-003.npz    depth, labels, joints, hand; both maps, q, allowed pushes
LOG/decision-003.json   the push, what was refused, coverage, times
LOG/undecided-003.npz   depth and joints of an image that could not be used
LOG/result.json         how the trial ended, or the error that ended it
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pregrasp_jax import io
from pregrasp_jax.deploy.contract import Contract
from pregrasp_jax.deploy.decision import Decision
from pregrasp_jax.deploy.devices import Frame
from pregrasp_jax.deploy.projection import Maps
from pregrasp_jax.messages import one_line
from pregrasp_jax.spaces import motion

FORMAT = "pregrasp_jax decision 1"


class DecisionLog:
    """A folder that decisions are written to."""

    def __init__(self, folder: Path, contract: Contract):
        """Make the folder.

        Raises:
            ValueError: it cannot be written, or holds the decisions of another trial.
        """
        io.refuse_unwritable(folder / "decision")
        if folder.is_dir() and any(path for kind in ("decision", "undecided") for path in folder.glob(f"{kind}-*")):
            raise ValueError(f"{folder} holds the decisions of an earlier trial; allowed is a new folder")
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._contract = folder, contract

    def write(
        self,
        number: int,
        *,
        frame: Frame,
        labels: np.ndarray,
        maps: Maps,
        hand: motion.Held,
        decision: Decision,
        times_ms: Mapping[str, float],
    ) -> None:
        """Write decision `number`."""
        name = f"decision-{number:03d}"
        q = np.zeros(decision.allowed.shape, np.float32) if decision.q is None else decision.q
        arrays = {"depth": frame.depth, "labels": labels, "joint_pos": frame.joint_pos, "allowed": decision.allowed}
        arrays |= {"hand": np.array([*hand.xy, hand.z, hand.yaw, hand.aperture]), "q": q}
        arrays |= {"height_m": maps.height_m, "map_labels": maps.labels}
        io.write_npz(self._folder / f"{name}.npz", **arrays, **_color(frame))
        push = decision.push
        choices = self._contract.action.choices
        about = {
            "format": FORMAT,
            "number": number,
            "time_s": frame.time_s,
            "close": decision.close,
            "coverage": decision.coverage,
            "cells_seen": maps.seen,
            "push": None
            if push is None
            else {
                "action": push.action,
                "row": push.row,
                "col": push.col,
                "choice": choices[push.choice].name,
                "value": push.value,
                "end_table_m": [float(x) for x in push.poses[-1, :3]],
                "end_base": [float(x) for x in push.base_pose],
                "seconds": push.seconds,
            },
            "searched": decision.searched,
            "refused": [[action, reason] for action, reason in decision.refused[:20]],
            "times_ms": {key: round(value, 3) for key, value in times_ms.items()},
            "policy": self._contract.training.parameters_hash,
            "labels": dict(self._contract.grid.labels),
            "choices": [choice.name for choice in choices],
        }
        io.write_json(self._folder / f"{name}.json", about)

    def keep(self, number: int, frame: Frame) -> None:
        """Write an image from which decision `number` could not be made."""
        arrays = {"depth": frame.depth, "joint_pos": frame.joint_pos, **_color(frame)}
        io.write_npz(self._folder / f"undecided-{number:03d}.npz", **arrays)

    def conclude(self, result: Mapping[str, Any]) -> None:
        """Write how the trial ended."""
        io.write_json(self._folder / "result.json", dict(result))


def _color(frame: Frame) -> dict[str, np.ndarray]:
    return {} if frame.color is None else {"color": frame.color}


def draw_log(folder: Path) -> list[Path]:
    """Draw every decision of a log beside it, .png.

    Raises:
        ValueError: the folder holds none, or one that cannot be read.
    """
    from pregrasp_jax import drawing

    written = []
    for path in sorted(folder.glob("decision-*.json")):
        about, arrays = _read(path)
        try:
            picture = _draw(about, arrays)
        except Exception as error:  # whatever is missing, or of another kind
            raise ValueError(f"{path} is damaged ({one_line(error)}); allowed is what `deploy --log` writes") from None
        drawing.save_image(path.with_suffix(".png"), picture)
        written.append(path.with_suffix(".png"))
    if not written:
        raise ValueError(f"{folder} holds no decisions; allowed is a folder that `deploy --log` has written")
    return written


def _draw(about: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return heights, labels and values of a decision side by side, and its push."""
    from pregrasp_jax import drawing

    push, start = about["push"], arrays["hand"][:2].tolist()
    height = np.clip(arrays["height_m"] / 0.30 * 255, 0, 255).astype(np.uint8)
    tiles = [drawing.draw_heightmap(height), drawing.draw_labels(arrays["map_labels"], about["labels"])]
    allowed = arrays["q"][arrays["allowed"]]
    limits = (float(allowed.min()), float(allowed.max())) if allowed.size else (0.0, 1.0)
    for index, choice in enumerate(about["choices"]):
        taken = push is not None and push["choice"] == choice
        arrow = (start, push["end_table_m"][:2]) if taken else None
        mask = arrays["allowed"][..., index]
        tiles.append(drawing.draw_q_map(arrays["q"][..., index], mask, push=arrow, limits=limits, backdrop=height))
    return np.concatenate(tiles, axis=1)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    try:
        about = json.loads(path.read_bytes())
        if about.get("format") != FORMAT:
            raise ValueError("it is not a decision")
        with np.load(path.with_suffix(".npz"), allow_pickle=False) as file:
            return about, {name: file[name] for name in file.files}
    except Exception as error:  # whatever is wrong with the files
        raise ValueError(f"{path} cannot be read ({one_line(error)}); allowed is a `deploy --log`") from None
