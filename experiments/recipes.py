"""What `experiments.closed_loop` trains and rolls out."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import torch

from pipeline.base.config import RolloutAblation
from pipeline.base.observation import Observation
from pipeline.policy import robot_state, shape
from pipeline.policy.policy import Policy
from pipeline.robot.readings import RobotMemory

AS_IT_IS, ON_TIME = "as it is", "on time"
NOT_ANCHORED, NEWEST = "not anchored", "newest chunk"
"""How policies were trained and played before anchoring; tables of that time keep to it."""


@dataclass(frozen=True)
class Store:
    """The stages that make a store, with what is set for them, and what is set to train on it.

    `{out}` stands for the folder of the experiments.
    """

    steps: tuple[tuple[str, tuple[str, ...]], ...] = ()
    settings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Recipe:
    """Params that are set, and names of the code with what stands there instead."""

    params: tuple[str, ...] = ()
    patches: Mapping[str, Any] = field(default_factory=dict)
    store: str = "demo"


@dataclass(frozen=True)
class Table:
    """Which policies, and how each is rolled out."""

    recipes: tuple[str, ...]
    rollouts: tuple[str, ...] = (ON_TIME,)


def store_settings(recipe: Recipe, out: Path) -> list[str]:
    """What is set so that a recipe's policy is trained on its store, with its model."""
    return [text.format(out=out) for text in STORES[recipe.store].settings]


_MANY = (
    "demo.recordings={out}/many",
    "demo.checkpoint={out}/many_vlm",  # written beside it, and not used
    "demo.episodes=107",
    "data.root={out}/many",
    "extract.store={out}/many.zarr",
)
_TUNED = ("vlm.adapter={out}/tuned/best/adapter", "extract.store={out}/tuned.zarr")
_TUNING = ("finetune.output={out}/tuned", "finetune.logs={out}/tuned-logs")
_POOLER = ("train_head.feature_encoder.kind=pooler",)
LARGE_IMAGES = ("vlm.image_resize_height=224", "vlm.image_resize_width=392")
_LARGE = (*LARGE_IMAGES, "extract.store={out}/large.zarr")

_TWO_LAYERS = "vlm.layers=[1, -1]"
SLOTS: dict[str, tuple[str, ...]] = {
    "mean": ("vlm.pooling=[mean]",),
    "grid 2x2": ("vlm.pooling=[{{grid: [2, 2]}}]",),
    "grid 8x8": ("vlm.pooling=[{{grid: [8, 8]}}]",),
    "tokens": ("vlm.pooling=[tokens]",),
    "tokens of two layers": ("vlm.pooling=[tokens]", _TWO_LAYERS),
    "int8": ("extract.dtype=int8",),
    "float8": ("extract.dtype=float8",),
    **{f"pca {k} in int8": (f"extract.dtype={{{{pca: {k}, then: int8}}}}",) for k in (32, 64)},
    "tokens in int8": ("vlm.pooling=[tokens]", "extract.dtype=int8"),
    "tokens of the vision tower": ("vlm.pooling=[tokens]", "vlm.layers=[vision]"),
}
"""What a store keeps of the demo's recordings, beside the demo's own mean and grid."""
EIGHT_BITS = ("int8", "float8", "pca 32 in int8", "pca 64 in int8")


def _store_of(name: str) -> Store:
    settings = (*SLOTS[name], f"extract.store={{out}}/{name.replace(' ', '-')}.zarr")
    return Store((("extract", settings),), settings)


_TOKENS = _store_of("tokens")
_TUNED_TOKENS = (
    *("vlm.pooling=[tokens]", "vlm.adapter={out}/tuned-tokens/best/adapter"),
    "extract.store={out}/tuned-tokens.zarr",
)
_TUNING_TOKENS = (
    *(*_TOKENS.settings, *_POOLER),
    *("finetune.output={out}/tuned-tokens", "finetune.logs={out}/tuned-tokens-logs"),
)

STORES = {
    "demo": Store(),
    **{name: _store_of(name) for name in SLOTS},
    # 428 recordings, of which about 300 are trained on.
    "many": Store((("demo", _MANY), ("extract", _MANY)), _MANY),
    "tuned": Store((("finetune", _TUNING), ("extract", _TUNED)), _TUNED),
    "tuned tokens": Store(
        (*_TOKENS.steps, ("finetune", _TUNING_TOKENS), ("extract", _TUNED_TOKENS)), _TUNED_TOKENS
    ),
    "large": Store((("extract", _LARGE),), _LARGE),
}

LATE = {f"{ms} ms": ms for ms in (100, 300, 600, 1000)}
"""Ways to roll out with a late model, and what a pass takes."""
_NEWEST = "rollout.chunking=none"

# {folder} stands for that of the policy, {out} for that of the experiments.
ROLLOUTS: dict[str, tuple[str, ...]] = {
    ON_TIME: (),
    "depth": ("rollout.level=depth",),
    "moved": ("rollout.level=moved",),
    NEWEST: (_NEWEST,),
    "rtc": ("rollout.chunking=rtc", "rollout.execute=3"),
    **{late: (f"rollout.latency_ms={ms}",) for late, ms in LATE.items()},
    **{
        f"moved, {late}": ("rollout.level=moved", f"rollout.latency_ms={LATE[late]}")
        for late in LATE
    },
    **{f"{NEWEST}, {late}": (_NEWEST, f"rollout.latency_ms={ms}") for late, ms in LATE.items()},
    **{f"{late}, state too": (f"rollout.latency_ms={ms}",) for late, ms in LATE.items()},
    **{f"{n} steps": (_NEWEST, f"rollout.execute={n}") for n in (2, 3, 4, 6, 8)},
    **{f"state {late}": () for late in LATE},
    "last weights": ("rollout.checkpoint={folder}/model/last",),
    "the policy it was tuned with": ("rollout.checkpoint={out}/tuned-tokens/best",),
    "spoilt": (f"rollout.ablations={json.dumps(get_args(RolloutAblation))}",),
}


def _late_state(latency_s: float) -> Any:
    """`RobotMemory.sense` of states that come `latency_s` late; the sensor stays on time."""

    def sense(memory: RobotMemory, readings: Mapping[str, Any]) -> None:
        waiting = memory.__dict__.setdefault("waiting", [])
        waiting.append((float(readings["time"][0]), readings))
        due = waiting[0][0] <= waiting[-1][0] - latency_s + 1e-9
        state = waiting.pop(0)[1] if due else {}
        now = {name: value for name, value in readings.items() if not name.startswith("state")}
        _sense(memory, now | {name: state[name] for name in ("state", "state_time") if due})

    return sense


_sense = RobotMemory.sense
_SENSE = "pipeline.robot.readings.RobotMemory.sense"
PATCHES: dict[str, dict[str, Any]] = {
    text.format(late): {_SENSE: _late_state(ms / 1000)}
    for late, ms in LATE.items()
    for text in ("{}, state too", "state {}")
}
"""What stands in the code in place of a name, for one way to roll out."""


def _plain(names: Any, units: Any) -> tuple[str, ...]:
    return ("plain",) * len(names)


def _no_age(encoder: Any, age_s: torch.Tensor) -> torch.Tensor:
    return age_s.new_zeros(len(age_s), encoder.network[-1].out_features)


_expand, _expanded_names = robot_state.expand, shape.expanded_names


def _with_motion(values: torch.Tensor, kinds: Sequence[str]) -> torch.Tensor:
    """The expanded states, and each channel less what it is now: how the robot has moved."""
    unit = {"deg": math.pi / 180, "rotation": math.pi / 180}
    moved = (values - values[:, -1:]) * values.new_tensor([unit.get(kind, 1.0) for kind in kinds])
    angle = torch.tensor([kind != "plain" for kind in kinds], device=values.device)
    return torch.cat([_expand(values, kinds), torch.where(angle, moved.sin(), moved)], dim=-1)  # type: ignore[arg-type]


def _with_motion_names(names: Sequence[str], kinds: Sequence[str]) -> list[str]:
    return [*_expanded_names(names, kinds), *(f"{name}_moved" for name in names)]  # type: ignore[arg-type]


_MOTION = {
    "pipeline.policy.policy.expand": _with_motion,
    "pipeline.train.statistics.expand": _with_motion,
    "pipeline.policy.shape.expanded_names": _with_motion_names,
    "pipeline.train.statistics.expanded_names": _with_motion_names,
}
_LATE = ("train_head.feature_lag=2",)
_TICK = ("train_head.anchor=none",)
_DIFFUSION = ("train_head.model_type=diffusion",)
_FLOW_MATCHING = ("train_head.model_type=flow_matching",)
_ONE_NOISE = ("train_head.diffusion.draws=1", "train_head.flow_matching.draws=1")
_BRIEFLY = (
    *("train_head.max_steps=200", "train_head.batch_size=16", "train_head.warmup_steps=20"),
    "train_head.eval_every=50",
)
_LONGER = ("train_head.max_steps=2000", "train_head.eval_every=200")
_300 = ("train_head.split.train=300",)


def _motion(observation: Observation) -> torch.Tensor:
    """What the arm did in the last 0.1 s as an action (batch, 1, 7): translation alone, in mm."""
    before = (observation.state_age - observation.state_age[:, -1:] - 0.1).abs().argmin(dim=1)
    rows = torch.arange(len(before))
    moved = observation.state[rows, -1, 6:9] - observation.state[rows, before, 6:9]
    moved = moved * (observation.state_valid > 1).unsqueeze(-1)
    return torch.nn.functional.pad(moved, (0, 4)).unsqueeze(1)


def _residual_loss(policy: Policy, observation: Observation, action: Any, *rest: Any) -> Any:
    return _loss(policy, observation, action - _motion(observation), *rest)


def _residual_sample(policy: Policy, observation: Observation, *rest: Any) -> Any:
    return _sample(policy, observation, *rest) + _motion(observation)


_loss, _sample = Policy.loss, Policy.sample
_RESIDUAL = {
    "pipeline.policy.policy.Policy.loss": _residual_loss,
    "pipeline.policy.policy.Policy.sample": _residual_sample,
}

RECIPES = {
    AS_IT_IS: Recipe(),
    # slots and their readers
    **{name: Recipe(store=name) for name in ("mean", "grid 2x2", "grid 8x8", "tokens")},
    **{name: Recipe(store=name) for name in EIGHT_BITS},
    "history of 3": Recipe(("train_head.feature_history=3",)),
    "grid, pooler": Recipe(_POOLER),
    "tokens, read as a mean": Recipe(("train_head.feature_encoder.kind=mean",), store="tokens"),
    **{f"{name}, pooler": Recipe(_POOLER, store=name) for name in SLOTS if "tokens" in name},
    NOT_ANCHORED: Recipe(_TICK),
    # experts and fusions
    "diffusion": Recipe(_DIFFUSION),
    "flow matching": Recipe(_FLOW_MATCHING),
    "diffusion, one noise": Recipe((*_DIFFUSION, *_ONE_NOISE)),
    "flow matching, one noise": Recipe((*_FLOW_MATCHING, *_ONE_NOISE)),
    "cross attention": Recipe(("train_head.fusion_strategy=cross_attention",)),
    "gated": Recipe(("train_head.fusion_strategy=gated",)),
    "no fusion": Recipe(("train_head.fusion_strategy=none",)),
    # inputs
    "no features": Recipe(("train_head.features_enabled=false",)),
    "no sensor": Recipe(("train_head.sensor_enabled=false",)),
    "no state": Recipe(("train_head.robot_state_enabled=false",)),
    "readings by their order": Recipe(
        ("train_head.sensor_window_s=null", "train_head.state_window_s=null")
    ),
    "angles as numbers": Recipe(
        patches={
            # First where it was imported to: an import that comes later must not see the patch.
            "pipeline.train.statistics.channel_kinds": _plain,
            "pipeline.policy.shape.channel_kinds": _plain,
        }
    ),
    "no ages": Recipe(patches={"pipeline.policy.ages.AgeEncoder.forward": _no_age}),
    "no bounds, no floor": Recipe(
        patches={
            "pipeline.policy.policy._LARGEST": 1e9,
            "pipeline.policy.normalization._LEAST_SPREAD": 0.0,
        }
    ),
    "own motion seen": Recipe(_TICK, _MOTION),
    "own motion seen, dropped": Recipe((*_TICK, "train_head.drop_state=0.5"), _MOTION),
    # how it learns
    "four times as long": Recipe(_LONGER),
    "flow matching, four times as long": Recipe((*_LONGER, *_FLOW_MATCHING)),
    "late in training": Recipe(_LATE),
    "somewhat late in training": Recipe(
        ("train_head.feature_lag=1", "train_head.sensor_lag_s=0.05")
    ),
    "rotations anchored": Recipe(("train_head.anchor=[dx, dy, da, db, dr]",)),
    "depth anchored": Recipe(("train_head.anchor=[dx, dy, dz]",)),
    "state dropped": Recipe(("train_head.drop_state=0.8",)),
    "not averaged": Recipe(("train_head.ema_decay=0.0",)),
    "horizon 16": Recipe(("train_head.horizon=16",)),
    "residual over own motion": Recipe(_TICK, _RESIDUAL),
    # how much it has seen
    **{
        f"{count} demonstrations": Recipe((f"train_head.split.train={count}",), store="many")
        for count in (10, 30, 100, 300)
    },
    "diffusion, 300 demonstrations": Recipe((*_300, *_DIFFUSION), store="many"),
    "flow matching, 300 demonstrations": Recipe((*_300, *_FLOW_MATCHING), store="many"),
    # what sees
    "tuned model": Recipe(store="tuned"),
    "tuned tokens, pooler": Recipe(_POOLER, store="tuned tokens"),
    # as many samples as the tuning sees
    "tuned tokens, pooler, briefly": Recipe((*_POOLER, *_BRIEFLY), store="tuned tokens"),
    "larger images": Recipe(store="large"),
}

_LATER = (ON_TIME, *LATE)
_AS_BEFORE = tuple(way for way in ROLLOUTS if way.startswith(NEWEST))
_DRAWN = ("diffusion", "flow matching")
TABLES = {
    "experts": Table((AS_IT_IS, *_DRAWN, "cross attention", "gated", "no fusion")),
    "drawn": Table(_DRAWN, (ON_TIME, NEWEST, "600 ms")),
    "noises": Table(("diffusion, one noise", "flow matching, one noise")),
    "inputs": Table(
        (NOT_ANCHORED, "own motion seen", "own motion seen, dropped", "residual over own motion"),
        (NEWEST,),
    ),
    "streams": Table((AS_IT_IS, "no state", "no sensor", "no features")),
    "rules": Table(
        (
            AS_IT_IS,
            "readings by their order",
            "angles as numbers",
            "no ages",
            "no bounds, no floor",
            "somewhat late in training",
        )
    ),
    "spoilt": Table((AS_IT_IS,), ("spoilt",)),
    "checkpoint": Table((AS_IT_IS,), (ON_TIME, "last weights")),
    "levels": Table((AS_IT_IS, "300 demonstrations"), (ON_TIME, "depth", "moved")),
    "latency": Table((AS_IT_IS, "late in training"), _LATER),
    "before": Table((NOT_ANCHORED,), _AS_BEFORE),
    "moved": Table((AS_IT_IS,), ("moved", *(f"moved, {late}" for late in LATE))),
    "anchors": Table((AS_IT_IS, "rotations anchored", "depth anchored"), (ON_TIME, "600 ms")),
    "leaning": Table((AS_IT_IS, "state dropped"), (ON_TIME, "600 ms", "spoilt")),
    "oracle": Table(
        (AS_IT_IS, NOT_ANCHORED),
        tuple(way for way in PATCHES if "100 ms" not in way),
    ),
    "chunking": Table((AS_IT_IS,), (ON_TIME, NEWEST, *(f"{n} steps" for n in (2, 3, 4, 6, 8)))),
    "guided": Table(("flow matching",), (ON_TIME, NEWEST, "3 steps", "rtc")),
    "demonstrations": Table(tuple(f"{count} demonstrations" for count in (10, 30, 100, 300))),
    "many": Table(("300 demonstrations",), _LATER),
    "many, drawn": Table(tuple(f"{name}, 300 demonstrations" for name in _DRAWN)),
    "slots": Table(
        (
            AS_IT_IS,
            "mean",
            "grid 2x2",
            "tokens, pooler",
            "tokens in int8, pooler",
            "grid 8x8",
            "tokens of the vision tower, pooler",
            "tokens of two layers, pooler",
            "tokens",
            "tokens, read as a mean",
            "grid, pooler",
        )
    ),
    "bytes": Table(
        (AS_IT_IS, *EIGHT_BITS, "tokens in int8, pooler", "history of 3"),
    ),
    "model": Table((AS_IT_IS, "tuned model")),
    "tuned tokens": Table(("tokens, pooler", "tuned tokens, pooler")),
    "live": Table(("tuned tokens, pooler",), (ON_TIME, "the policy it was tuned with")),
    "briefly": Table(("tuned tokens, pooler, briefly",)),
    "images": Table((AS_IT_IS, "larger images")),
    "learning": Table((AS_IT_IS, "horizon 16", "not averaged")),
    "longer": Table(("four times as long", "flow matching, four times as long")),
}
