"""The endpoints, one module for each path; here alone all other rooms meet."""
