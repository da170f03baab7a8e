"""The command line: a family of commands per file; cli.py combines them and is the program's entry."""
