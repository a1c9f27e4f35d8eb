"""What the subcommands do, as functions."""
