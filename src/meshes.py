"""`python -m src.meshes`: see `meshspiral.commands.meshes`."""

from meshspiral.commands.meshes import main

if __name__ == "__main__":
    main()
