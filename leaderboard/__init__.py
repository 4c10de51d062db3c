"""The published leaderboard: a static site made from judged runs and nothing else."""
