/* Loads a unit's library for Windows: x(n) and e(n) come in, y(n) goes out; its arguments are the
 * library and its token. */
#include "fmi3Functions.h"
#include <fcntl.h>
#include <io.h>
#include <stdio.h>
#include <windows.h>

#define CALL(name) ((name##TYPE *)(void (*)(void))GetProcAddress(unit, #name))

int main(int argc, char **argv)
{
    const fmi3ValueReference inputs[] = {1, 2}, output[] = {3};
    const HMODULE unit = LoadLibraryA(argv[argc - 2]);
    double in[2], y, last;
    bool flags[3];
    _setmode(_fileno(stdin), _O_BINARY), _setmode(_fileno(stdout), _O_BINARY);
    void *one = CALL(fmi3InstantiateCoSimulation)("a", argv[argc - 1], "", 0, 0, 0, 0, NULL, 0,
                                                  NULL, NULL, NULL);
    for (long n = 0; fread(in, sizeof in, 1, stdin) == 1; n++) {
        int failed = CALL(fmi3SetFloat64)(one, inputs, 2, in, 2);
        failed |=
            CALL(fmi3DoStep)(one, n / 8000.0, 1 / 8000.0, 1, flags, flags + 1, flags + 2, &last);
        failed |= CALL(fmi3GetFloat64)(one, output, 1, &y, 1);
        if (failed) return 1;
        fwrite(&y, sizeof y, 1, stdout);
    }
    return 0;
}
