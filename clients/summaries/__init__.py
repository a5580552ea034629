"""What scene files contain, in numbers and in pictures."""
