"""What several test modules share: scenes, controllers, comparisons."""
