"""What a world model knows of whole episodes that it was not trained on."""
