"""Submissions: runs packed with all that is needed to judge them again."""
