"""Chapter 4: values as critics. The learners of Algorithms 3 to 5 are settings of `policy_gradient.vanilla`."""
