"""Arguments of another type than a function takes, refused where they are given."""

from itertools import permutations


def check_arguments(function: str, **arguments: tuple[object, type]) -> None:
    """Refuse arguments of other types; the function's own parameters are the keywords, in order.

    Parameters
    ----------
    **arguments : (object, type)
        What was given, and what it must be.

    Raises
    ------
    TypeError
        In one sentence, which says so where they were swapped.
    """
    given = [value for value, _ in arguments.values()]
    wanted = [kind for _, kind in arguments.values()]
    if all(map(isinstance, given, wanted)):
        return
    call = f"{function}({', '.join(arguments)})"
    if any(all(map(isinstance, order, wanted)) for order in permutations(given)):
        raise TypeError(f"{call}: the arguments are swapped; give them in this order")
    name, (value, kind) = next(
        (name, pair) for name, pair in arguments.items() if not isinstance(*pair)
    )
    raise TypeError(f"{call}: {name} must be a {kind.__name__}; got a {type(value).__name__}")
