"""Planning in the words of OpenAI's chat completions."""
