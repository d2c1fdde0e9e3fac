"""What people do with a trained avatar: drive it, look at it, measure how it moves."""
