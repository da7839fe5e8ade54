"""What every room needs: checks of arguments, files, progress, pages, array types."""
