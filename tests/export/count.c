/* What every multiplication of a program calls: it tells at its end how many there were. */
#include <stdio.h>
static long multiplications;
void count(void) { multiplications++; }
__attribute__((destructor)) static void tell(void) { fprintf(stderr, "%ld", multiplications); }
