"""Commands of the laboratory, a family each; entry points `rotorwatch.commands` name them."""
