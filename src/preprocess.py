"""`python -m src.preprocess`: see `meshspiral.commands.preprocess`."""

from meshspiral.commands.preprocess import main

if __name__ == "__main__":
    main()
