"""`python -m src.evaluate`: see `meshspiral.commands.evaluate`."""

from meshspiral.commands.evaluate import main

if __name__ == "__main__":
    main()
