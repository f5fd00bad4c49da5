"""What alignment is worth to pansharpening."""
