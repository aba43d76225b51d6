"""The presets: whole configurations by name."""

import dataclasses

from pregrasp_jax.config import (
    Config,
    ExplorationConfig,
    LearnerConfig,
    NetworkConfig,
    ReplayConfig,
    SceneConfig,
    StrokesConfig,
    TaskConfig,
    TrainConfig,
)

_CPU = Config(
    scene=SceneConfig(validation_scenes=100),
    network=NetworkConfig(architecture="compact", width=0.25, initial_bias=0.5, mirror=True),
    replay=ReplayConfig(capacity=100_000, importance_fraction=0.8),
    learner=LearnerConfig(
        learning_rate=1e-3,
        final_learning_rate=2e-5,
        learning_rate_fraction=0.8,
        polyak=0.995,
        huber_delta=1.0,
        updates_per_step=2.0,
    ),
    exploration=ExplorationConfig(epsilon_fraction=0.16, branches=3),
    train=TrainConfig(num_envs=16, episodes=25_000, minutes=150.0, evaluate_every=2_500),
)

PRESETS: dict[str, Config] = {
    "ci": Config(
        scene=SceneConfig(train_scenes=4, validation_scenes=2, test_scenes=2),
        network=NetworkConfig(width=0.0625),
        replay=ReplayConfig(capacity=256, importance_steps=200),
        learner=LearnerConfig(batch_size=4, warmup=8, updates_per_step=0.5, learning_rate_steps=0),
        exploration=ExplorationConfig(epsilon_decay=64),
        train=TrainConfig(num_envs=2, episodes=1_000_000, minutes=1.0, evaluate_every=0, log_every=2),
    ),
    "demo": dataclasses.replace(
        _CPU,
        scene=SceneConfig(train_scenes=64, validation_scenes=10, test_scenes=50),
        replay=ReplayConfig(capacity=10_000, importance_fraction=1.0),
        learner=dataclasses.replace(_CPU.learner, final_learning_rate=1e-4, learning_rate_fraction=1.0),
        exploration=dataclasses.replace(_CPU.exploration, epsilon_fraction=1.0),
        train=TrainConfig(num_envs=16, episodes=2_000, minutes=5.0, evaluate_every=0),
    ),
    "cpu": _CPU,
    "paper": Config(),
    "ppg": Config(
        task=TaskConfig(robot="barrett", primitive="push_grasp"),
        strokes=StrokesConfig(positives=5_000),
        train=TrainConfig(method="imitation"),
    ),
}
"""`ci`: 2 scenes, a minute, for tests. `demo`: minutes, shows every part. `cpu`: two cores, 150 minutes.
`paper`: width 1.0, 45 K episodes, as published. `ppg`: a baseline of the paper, another hand and method."""
