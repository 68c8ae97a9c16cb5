"""`python -m src.cache`: see `meshspiral.commands.cache`."""

from meshspiral.commands.cache import main

if __name__ == "__main__":
    main()
