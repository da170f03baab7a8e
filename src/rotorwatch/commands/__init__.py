"""The command line: a family of commands a file; cli.py puts them together and is the program's entry."""
