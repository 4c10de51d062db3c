"""The closed loop as a hybrid automaton: built once, printed in several languages."""
