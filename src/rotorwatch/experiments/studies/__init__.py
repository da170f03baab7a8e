"""Experiments on the default diagnoser: what it promises, measured."""
