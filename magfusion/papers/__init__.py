"""The four papers, one room each: their equations as printed, their methods, and what is true.

Each room has a module ``equations`` in the paper's order: ``eq_07_...`` is its Eq 7, whole or in
parts, and ``NOT_FUNCTIONS`` gives a reason for each number that has no function.  Every one says
what is known of it:

- *Right*: it holds as printed.
- *Misprint* or *False*: it cannot be used as printed; ``eq_07_..._as_printed`` keeps it, so that
  its error can be shown.
- *Corrected*: what this package computes in its place.
- *Unclear*: the source has lost it, and this is a reading.
"""
