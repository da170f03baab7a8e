"""`python -m rotorwatch`: the command line, where the folder of its script is not on PATH."""

from rotorwatch.commands.cli import main

if __name__ == "__main__":
    main()
