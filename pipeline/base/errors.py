"""What can go wrong, named.

Every `PipelineError` is something the user can mend: a stage prints it without a traceback and
exits with 2. Its message says what was expected, what was found, where, and what to run next.
Each child is also the builtin that a caller would have caught without knowing this package.
"""


class PipelineError(Exception):
    """Base of everything the user can mend."""


class ConfigError(PipelineError, ValueError):
    """A value of params.yaml or of `--set` is not what it must be."""


class ObservationError(PipelineError, ValueError):
    """What a policy is given to look at is not what it takes."""


class RecordingError(PipelineError, ValueError):
    """A recording on disk is missing something or contradicts itself."""


class VLMError(PipelineError, ValueError):
    """A vision-language checkpoint or adapter cannot be used as it is."""


class StoreMismatch(PipelineError, ValueError):
    """A store holds something else than what was asked of it."""


class StoreIncomplete(PipelineError, RuntimeError):
    """A store is missing, unfinished or damaged."""


class StoreLocked(PipelineError, RuntimeError):
    """Another process is building this store."""


class DiskFull(PipelineError, OSError):
    """Too little space for what has to be written."""


class TooManyMaps(PipelineError, OSError):
    """The kernel maps no more files into this process."""


class NumericsError(PipelineError, ArithmeticError):
    """A NaN or an infinity where a number must be."""


class CheckpointMismatch(PipelineError, ValueError):
    """A policy checkpoint does not fit the store, the params or the model it is used with."""


class CheckpointIncomplete(PipelineError, RuntimeError):
    """A policy checkpoint is missing, unfinished or damaged."""


class WireError(PipelineError, ValueError):
    """A message between robot and server is not what it must be."""


class ServerError(PipelineError, ConnectionError):
    """A policy server cannot be reached, refuses the connection, or is gone."""


class ServerBusy(ServerError):
    """A policy server has more observations waiting than it takes; the connection stays."""
