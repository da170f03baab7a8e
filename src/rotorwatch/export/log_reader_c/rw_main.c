/* rotorwatch-c LOG: the answer to a log as JSON on standard output. Exit code 2, with a sentence on standard error, where it has none. */
#include "rw_log.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int refuse(const char *name, const char *why)
{
    fprintf(stderr, "%s: %s\n", name, why);
    return 2;
}

int main(int count, char **arguments)
{
    uint8_t *data = NULL, *more;
    size_t size = 0, room = 0, got;
    const char *name, *slash;
    char *answer;
    FILE *file;
    int failed;
    if (count != 2)
        return refuse("rotorwatch-c", "give one log: a ULog of PX4 (.ulg) or a DataFlash log of ArduPilot (.bin)");
    name = (slash = strrchr(arguments[1], '/')) ? slash + 1 : arguments[1];
    if (!(file = fopen(arguments[1], "rb")))
        return refuse(arguments[1], "cannot be opened");
    do {
        if (size == room) {
            room = 2 * room + (1 << 20);
            if (!(more = realloc(data, room))) {
                fclose(file);
                free(data);
                return refuse(name, "there is not enough memory for this log");
            }
            data = more;
        }
        got = fread(data + size, 1, room - size, file);
        size += got;
    } while (got);
    failed = ferror(file);
    fclose(file);
    answer = failed ? NULL : rw_assess_log(data, size, name);
    free(data);
    if (!answer)
        return refuse(name, failed ? "cannot be read" : "there is not enough memory for this log");
    fputs(answer, stdout);
    failed = strstr(answer, "\"error\": ") && !strstr(answer, "\"verdict\": ");
    if (failed) {
        const char *why = strstr(answer, "\"error\": \"") + 10;
        fprintf(stderr, "%s: %.*s\n", name, (int)strcspn(why, "\""), why);
    }
    free(answer);
    return failed ? 2 : 0;
}
