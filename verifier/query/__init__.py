"""Questions about networks in VNN-LIB: a witness, or a proof that there is none.

The search computes in plain doubles; ``unsat`` is said only of what the checker has accepted.
"""
