"""Fault models as data: what they are, and what they make of the scans of numbered runs.

``spec`` holds the data types, ``named`` the models that the package brings along, ``numbers``
random numbers that depend on nothing but a seed and indices, ``reflect`` the walls that
swallow rays, and ``draw`` puts them together.
"""
