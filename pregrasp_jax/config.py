"""Every setting of a run: one frozen dataclass per stage.

The docstring under a field is its command-line help. `Config.validate` is called wherever a config enters
the program, so that a value out of range is one line before anything compiles.
"""

import operator
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from pregrasp_jax.ranges import RANGES
from pregrasp_jax.settings import check_ranges, from_dict

EngineName = Literal["native", "mjx"]
CameraName = Literal["orthographic", "pinhole"]
Architecture = Literal["paper", "compact"]
ObjectSet = Literal["seen", "unseen"]
Method = Literal["q_learning", "imitation"]
FreeSpace = Literal["feasible", "cluster"]
Normalization = Literal["none", "batch"]

STYLES = ("ppg", "target-ppg")
"""Ways of playing a policy of strokes, and names of the one that ships."""

PUSHING = ("pretrained", "cpu-1")
"""Names of the policies of pushes that ship: the best, and what the preset `cpu` makes with seed 1 in 100 minutes."""


@dataclass(frozen=True, kw_only=True)
class AssetsConfig:
    """Which objects."""

    object_dir: str | None = None
    """Folder of meshes, see docs/meshes.md (DIR/seen and DIR/unseen if present); None is the built-in catalogue."""
    object_set: ObjectSet = "seen"
    """Training uses `seen`; `unseen` holds objects kept for evaluation (Sec. IV-A)."""
    variants: int = 0
    """Objects made beside those of the set: scaled, drawn from families, cut and joined. Training meets them with the
    set's own; validation and `evaluate` meet only others that were made in the same way. See docs/unseen.md."""


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """Packed scenes: how many, and how crowded."""

    min_objects: int = 5
    """Fewest objects in a scene (Sec. IV-A)."""
    max_objects: int = 8
    """Most objects in a scene (Sec. IV-A); at most the 8 slots of the compiled model."""
    train_scenes: int = 512
    """Scenes in the training bank; every reset also draws a yaw and a target."""
    validation_scenes: int = 50
    """Scenes on which checkpoints are compared during training."""
    test_scenes: int = 200
    """Scenes of `pregrasp-jax evaluate`, with fixed yaw and target."""
    bank_seed: int = 0
    """Seed of the banks; training, validation and test draw from disjoint streams of it."""


@dataclass(frozen=True, kw_only=True)
class PlaceConfig:
    """Dimensions of the place; null is its own. One that it does not have is refused."""

    half_width: float | None = None
    """m, from the middle to the side walls of `shelf`, or to where the table ends in `narrow`."""
    back: float | None = None
    """m, x of the inner face of the back wall of `shelf`."""
    front: float | None = None
    """m, x where the side walls of `shelf` begin and objects leave."""
    wall_height: float | None = None
    """m."""
    wall_thickness: float | None = None
    """m."""


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """The task of the paper: pushes in a half ring, ten per episode."""

    workspace: str = "table"
    """Where: `table`, `shelf`, `narrow` or another name in `spaces.workspace.WORKSPACES` (docs/confined.md)."""
    place: PlaceConfig = field(default_factory=PlaceConfig)
    mirrored_start: bool = True
    """Between walls, start in the mirror image of the arm's posture if the target lies on the right (y < 0), so that
    the wrist is on the roomier side; False starts in one posture always."""
    robot: str = "ur5e_rg2"
    """Who: a name in `robot.ROBOTS`."""
    primitive: str = "push"
    """Does what, and judged how: a name in `task.registry.KINDS`."""
    r_in: float = 0.04
    """m, inner radius of the half ring (Eq. 1)."""
    r_out: float = 0.20
    """m, outer radius of the half ring (Eq. 1). `lookahead` does better at 0.20 than at 0.15 (docs/task.md)."""
    full_ring: bool = False
    """Allow backward pushes too: the paper's Full-Ring ablation."""
    max_pushes: int = 10
    """Pushes before an episode is truncated (Sec. IV-A)."""
    obstacles_may_leave: bool = False
    """Only the target ends an episode by leaving the workspace: how the paper counts failures (Sec. IV-A). False lets
    every object end it: how the paper trains (Sec. III-D), and stricter."""
    in_region_reward: float = 2.0
    """Reward for the target in the closing region (Sec. III-D)."""
    approach_reward: float = 0.5
    """Reward for a push that brings the hand closer to the target (Sec. III-D)."""
    push_speed: float = 0.1
    """m/s, mean speed of the minimum-jerk push."""
    camera: CameraName = "orthographic"
    """`orthographic` draws exact heightmaps; `pinhole` sees what a 640 x 480 overhead RGB-D camera sees."""
    sensor: str = "clean"
    """What that camera, the masks and the objects get wrong: clean, d435, d455, or a .yaml file (docs/deploy.md). Needs
    `pinhole`."""


@dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """Which engine steps the scenes."""

    engine: EngineName = "native"
    """`native`: MuJoCo's C engine on CPU threads; `mjx`: one XLA program."""
    threads: int = 0
    """Threads of the native engine; 0 takes every core. Results do not depend on it."""


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """The Q-network."""

    architecture: Architecture = "paper"
    """`paper`: Fig. 3 on the whole grid; `compact`: 2 cm patches of a window around the hand, for CPUs."""
    width: float = 1.0
    """Factor on all channel counts; 1.0 is the paper's 7.4 M parameters, 0.25 has 0.46 M (compact: 0.12 M)."""
    path_channels: int | None = None
    """Compact: channels of a second readout, which looks along the way of a push and tells cells of 5 mm apart; None
    takes those of `--init-from`, else 0. It joins a network that has none without changing its values."""
    initial_bias: float = 0.0
    """Q-value of every push before training."""
    mirror: bool = False
    """Average the values of a scene and of its mirror image, and learn from either at random."""
    members: int | None = None
    """Networks whose mean is the value; None takes as many as `--init-from` has, else one. They start apart and learn
    from the same pushes, each for itself; a decision and an update take so many times as long."""

    @property
    def num_members(self) -> int:
        """Return how many networks there are."""
        return self.members or 1

    @property
    def num_path_channels(self) -> int:
        """Return how many channels the second readout has."""
        return self.path_channels or 0


@dataclass(frozen=True, kw_only=True)
class ReplayConfig:
    """Prioritized replay with hindsight rows."""

    capacity: int = 50_000
    """Observations kept, 20 kB each."""
    priority_exponent: float = 0.6
    """Alpha of prioritized replay; 0 samples uniformly."""
    importance_exponent: float = 0.4
    """Beta at the start."""
    importance_steps: int | None = None
    """Env steps over which beta rises linearly to 1; None takes `importance_fraction` of the run."""
    importance_fraction: float = 5 / 6
    """Share of the run over which beta rises."""
    hindsight: bool = True
    """Replay episodes that enclosed an obstacle with that obstacle as the target; False is the No-HER ablation."""


@dataclass(frozen=True, kw_only=True)
class LearnerConfig:
    """Q-learning (Sec. III-E)."""

    optimizer: Literal["adam", "muon"] = "adam"
    """Adam as in the paper, or Muon for the kernels before the readout (docs/unseen.md)."""
    learning_rate: float = 1e-4
    """Step size of the optimizer."""
    final_learning_rate: float = 1e-4
    """Step size at the end of a linear decay."""
    learning_rate_steps: int | None = None
    """Updates over which the step size decays; 0 keeps it, None takes `learning_rate_fraction` of the run."""
    learning_rate_fraction: float = 1.0
    """Share of the run over which the step size decays."""
    discount: float = 0.5
    """Gamma."""
    polyak: float = 0.999
    """Share of the target network kept at each update."""
    huber_delta: float = 0.1
    """Where the Huber loss turns linear (Eq. 4)."""
    batch_size: int = 16
    """Transitions per update; with `mjx` on several devices a multiple of their number."""
    updates_per_step: float = 0.25
    """Updates per env step (a push of one scene); 16 scenes at 0.25 make 4 updates per parallel step."""
    siblings: bool = False
    """Learn from all pushes that were made from a state (`exploration.branches`) whenever one of them is sampled."""
    valued_share: float = 1.0
    """Share of a batch whose next states are valued anew, ends of episodes last; the others keep their last value."""
    warmup: int = 500
    """Env steps with `exploration.epsilon_start` before the first update."""


@dataclass(frozen=True, kw_only=True)
class ExplorationConfig:
    """Epsilon-greedy with guided random actions."""

    epsilon_start: float = 1.0
    """Share of random actions at the first env step."""
    epsilon_end: float = 0.1
    """Share of random actions after the decay."""
    epsilon_decay: int | None = None
    """Env steps over which epsilon falls linearly; None takes `epsilon_fraction` of the run."""
    epsilon_fraction: float = 1 / 9
    """Share of the run over which epsilon falls."""
    guided: bool = True
    """Random actions aim at the target in the half ring; False draws from all that the network values (Random-Exp)."""
    angle_std: float = 0.5
    """rad, spread of guided actions around the direction to the target."""
    open_probability: float = 0.7
    """Share of guided actions with an open hand."""
    branches: int = 0
    """More pushes simulated from every state, only to learn from: drawn like the real one, but softmax for greedy."""
    branch_temperature: float = 0.1
    """Temperature of that softmax, in units of Q."""
    branch_spacing: float = 0.0
    """m; greedy branches are the best pushes that end so far apart, as those of a search; 0 draws by the softmax."""


@dataclass(frozen=True, kw_only=True)
class StrokesConfig:
    """PPG: strokes learnt by imitation of random ones that ended in a stable grasp."""

    positives: int = 10_000
    """Stable grasps to collect before the training."""
    attempts: int = 15
    """Strokes in a scene before the next one; it also ends when at most one object is left."""
    singulation: bool = False
    """Learn only from grasps before which the push took the object 15 mm farther away from its neighbours."""
    collection: str | None = None
    """Run whose stable grasps are learnt from; null collects its own."""
    width: float = 0.25
    """Factor on all channel counts of the network; 1.0 has the 10 M parameters of the original."""
    normalization: Normalization = "none"
    """`batch` normalises as the original does, in training by the batch alone."""
    epochs: int = 15
    """Passes over the stable grasps."""
    batch_size: int = 8
    """Stable grasps per update."""
    learning_rate: float = 3e-4
    """Adam step size at the start; it falls to 0 along a half cosine."""
    validation_share: float = 0.1
    """Share of the stable grasps by whose loss the parameters are chosen that are kept."""
    mask_radius: float = 0.0
    """m; Target-PPG considers only strokes that begin so near to the target; 0 considers all."""
    free_space: FreeSpace = "feasible"
    """When Target-PPG reaches for the target: once a stroke can take it and nothing else, or (`cluster`) once nothing
    stands within 10 mm of it."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How long, how wide, how often."""

    method: Method = "q_learning"
    """`q_learning`: the paper's; `imitation`: PPG, see `strokes`."""

    num_envs: int = 16
    """Scenes stepped in parallel; with `mjx` on several devices a multiple of their number."""
    episodes: int = 45_000
    """Stop after this many episodes (the paper trains for 45 K) ..."""
    env_steps: int = 0
    """... or after this many env steps (pushes); 0 sets no limit ..."""
    minutes: float = 0.0
    """... or after this many minutes of training time, resumed time included; 0 sets no limit. The limit is the length
    that fractions of the run refer to: `env_steps` if given, else episodes of four pushes or the env steps that fit
    into the minutes, whichever is less. These are settled once, by the speed after the warm-up."""
    checkpoint_minutes: float = 5.0
    """Time between checkpoints: the most that a crash can lose."""
    evaluate_every: int = 5_000
    """Env steps between evaluations on the validation scenes; 0 evaluates only at the end."""
    log_every: int = 200
    """Env steps between rows of metrics.jsonl."""
    try_grasps: bool = False
    """Grasp whatever a push has enclosed, and reward only what the grasp holds. The paper rewards the enclosure; in the
    shelf one grasp in ten fails (docs/confined.md)."""
    tight_targets: float = 1.0
    """How many times likelier than one that fits between the fingers at every yaw an object that fits at hardly any
    becomes the target of a training scene; linear in the share of yaws. The paper draws evenly."""
    tensorboard: bool = False
    """Write the same numbers for TensorBoard, into the run folder (needs the extra `tensorboard`)."""
    fused_iterations: int | None = None
    """Pushes of every scene, with their updates, in one compiled program without the host; everything else happens
    between two of these. 0 leaves every step to the host; None chooses: 4 for `mjx` on accelerators, else 0."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """One run."""

    seed: int = 0
    """Seed of initial weights, exploration and resets."""
    assets: AssetsConfig = field(default_factory=AssetsConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    task: TaskConfig = field(default_factory=TaskConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    strokes: StrokesConfig = field(default_factory=StrokesConfig)
    train: TrainConfig = field(default_factory=TrainConfig)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Config":
        """Return the config of nested dicts; see `settings.from_dict`."""
        return from_dict(values, cls)

    def validate(self) -> "Config":
        """Return self.

        Raises:
            ValueError: a value is outside its range; one line names the key, the value and the range.
        """
        check_ranges(self, RANGES)
        if self.task.r_in >= self.task.r_out:
            raise ValueError(f"task.r_in = {self.task.r_in} must be below task.r_out = {self.task.r_out}")
        if (least := self.scene.min_objects) > (most := self.scene.max_objects):
            raise ValueError(f"scene.min_objects = {least} must not exceed scene.max_objects = {most}")
        branches = "branches", self.exploration.branches, "exploration.branches of 1 or more"
        compact = "patches", self.network.architecture == "compact", "network.architecture = compact"
        needs = {"network.path_channels": compact, "learner.siblings": branches, "exploration.branch_spacing": branches}
        for key, (subject, given, needed) in needs.items():
            if (value := operator.attrgetter(key)(self)) and not given:
                raise ValueError(f"{key} = {value} is about {subject}, and there are none; allowed is {needed} with it")
        return self


def with_absolute_paths(config: Config) -> Config:
    """Return a config whose folders and files mean the same from any working directory."""
    assets, task, strokes = config.assets, config.task, config.strokes
    if assets.object_dir is not None:
        assets = replace(assets, object_dir=os.path.abspath(assets.object_dir))
    if task.sensor.endswith((".yaml", ".yml")):
        task = replace(task, sensor=os.path.abspath(task.sensor))
    if strokes.collection is not None:
        strokes = replace(strokes, collection=os.path.abspath(strokes.collection))
    return replace(config, assets=assets, task=task, strokes=strokes)
