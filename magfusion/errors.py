"""Errors with which a job ends without its result."""


class InputError(ValueError):
    """Input that a user can correct.

    The message is one sentence with the file, the position in it, the invalid value and the
    remedy; the command line prints it and exits with 2.
    """


class EstimationError(RuntimeError):
    """Failure of an estimator on valid input; the command line exits with 1."""


class InputErrors(InputError):
    """Several errors in one message, so that a user can correct them together.

    `lines`: the first states what was rejected; then a sentence each, and the proposals.
    """

    def __init__(self, *lines: str) -> None:
        super().__init__("\n".join(lines))


# The reason of a failed estimate that jobs recognise.
UNOBSERVABLE = "the measurements do not determine the motion in one direction"
