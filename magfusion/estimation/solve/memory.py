"""Memory that GTSAM has freed, given back to the system."""

import ctypes


def give_back_memory() -> None:
    """Give what factors were in back to the system: glibc keeps it in small pieces."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):  # another system's library
        return
    trim(0)
