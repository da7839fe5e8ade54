"""Support for every package: checks of arguments, files, progress, HTML pages and array types."""
