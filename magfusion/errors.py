"""The two ways in which a job ends without its result."""


class InputError(ValueError):
    """Input that a user can correct.

    The message is one sentence that names the file, the place in it, what was found and the
    remedy; the command line prints it and exits with 2.
    """


class EstimationError(RuntimeError):
    """An estimator that failed on input that was well formed; the command line exits with 1."""


class InputErrors(InputError):
    """Several mistakes told at once, so that a user need not meet them one by one.

    Parameters
    ----------
    lines : sequence of str
        The first says what was refused; then a sentence each, and what is proposed.
    """

    def __init__(self, *lines: str) -> None:
        super().__init__("\n".join(lines))
