"""The same problems in pink or mink and in osik-jax: the numbers on the page on porting."""
