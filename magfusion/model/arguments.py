"""Type checks of function arguments, with errors that name the swapped or wrong one."""

from itertools import permutations


def check_arguments(function: str, **arguments: tuple[object, type]) -> None:
    """Reject arguments of wrong types; the keywords are the function's parameters, in order.

    `**arguments`: the value, and its required type. Raises TypeError in one sentence, which reports
    swapped arguments.
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
