"""How good a result is: errors, consistency."""
