"""Those who explain what is less good about a plan."""
