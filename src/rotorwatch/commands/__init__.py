"""The commands of the command line, a family a file; cli.py puts them together."""
