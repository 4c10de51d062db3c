"""The checker of proofs about networks: VNN-LIB questions, with certificates that divide boxes.

Like the rest of the checker it shares no code with the verifier, nor with the harness.
"""
