/* The processor's level, whatever its instructions answer. */
#include "anc.h"

int32_t anc_processor_level(void);
void Frama_C_show_each_level(int32_t level);

int main(void)
{
    Frama_C_show_each_level(anc_processor_level());
    return 0;
}
