"""The reference verifier: proves or refutes instances; run by the harness like any tool."""
