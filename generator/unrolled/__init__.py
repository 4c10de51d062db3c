"""The closed loop over several control steps as one network, for tools that read nothing else."""
