"""The independent checker of certificates: see docs/certificates.md.

It shares no code with the verifier, only the file formats. All arithmetic is on Arb balls
(python-flint): every result is an interval that contains the exact one.
"""
