"""`python -m src.train`: see `meshspiral.commands.train`."""

from meshspiral.commands.train import main

if __name__ == "__main__":
    main()
