"""Straight-line arithmetic, traced from Python and compiled with LLVM.

trace: what a kernel computes; emit: the same as LLVM's text; native: machine code of it;
kernel: calling it on arrays.
"""
