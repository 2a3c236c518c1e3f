"""The four papers, one subpackage each: equations as printed, methods, and their correctness.

Each subpackage has a module ``equations`` in the paper's order: ``eq_07_...`` is its Eq 7, whole or
in parts, and ``NOT_FUNCTIONS`` gives a reason for each number without a function.  Every equation
has one of these findings:

- *Right*: it holds as printed.
- *Misprint* or *False*: it cannot be used as printed; ``eq_07_..._as_printed`` keeps it, so that
  its error can be shown.
- *Corrected*: what this package computes instead.
- *Unclear*: the source is incomplete, and this is a reading.
"""
