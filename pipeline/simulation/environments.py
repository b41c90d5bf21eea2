"""The environments that `rollout.environment` may name."""

from collections.abc import Callable, Sequence

from pipeline.base.config import PHANTOM, Level
from pipeline.base.errors import ConfigError
from pipeline.base.named import make_named
from pipeline.simulation.interface import RobotEnvironment

_KEY = "rollout.environment"
_META_WORLD = "metaworld"


def environment_maker(
    name: str, level: Level, action_names: Sequence[str]
) -> Callable[[], RobotEnvironment]:
    """Makes environments of this name: `phantom`, `metaworld:TASK`, or `module:name` of the user.

    `level` is the phantom's, whose rotations follow those of the policy's `action_names`.
    """
    kind, _, task = name.partition(":")
    if name == PHANTOM:
        from pipeline.simulation.environment import InsertionEnvironment

        rotation = "rotvec" if "rx" in action_names else "euler_delta"
        return lambda: InsertionEnvironment(level, rotation, cameras=False)
    if kind == _META_WORLD:
        from pipeline.simulation.meta_world import MetaWorldEnvironment

        return lambda: MetaWorldEnvironment(task)
    return lambda: _of_the_user(name)


def _of_the_user(name: str) -> RobotEnvironment:
    made = make_named(_KEY, name)
    if not isinstance(made, RobotEnvironment):
        raise ConfigError(
            f"{_KEY}: {name}: expected a RobotEnvironment (pipeline.simulation.interface), found "
            f"{type(made).__name__}"
        )
    return made
